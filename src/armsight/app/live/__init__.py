"""``armsight live``: one page from two cameras that nobody has calibrated to a closed loop, with a stop that always works.

In: what the command line names (cameras, rig, body, board), and commands of a person or a program. Out: a folder with
everything that was done, in the forms of the other commands; and states and events to be shown.

:mod:`~armsight.app.live.session` is all of it without a page: it knows nothing of HTML, and Python drives it as a page
does, with the typed records of :mod:`~armsight.app.live.records`. :mod:`~armsight.app.live.server` carries them to the
page, ``page.html``, and decides nothing but who may command.

- ``capture``: reads the cameras in a thread and keeps the newest shot. ``quality``: what is wrong with an image, in words.
- ``calibration``: the guided calibration; ``guide``: which pose of the board is the best next one.
- ``body``, ``measuring``, ``arm``: the steps that follow. ``simulated``: the workcell, and a person who holds the board.
"""
