"""``armsight live``: one page from two cameras that nobody has calibrated to a closed loop, with a stop that always works.

:mod:`~armsight.app.live.session` is all of it without a page: it knows nothing of HTML, and Python drives it as a page
does, with the typed records of :mod:`~armsight.app.live.records`. :mod:`~armsight.app.live.server` carries them to the
page, ``page.html``, and decides nothing but who may command.
"""
