"""The control loop: what a board and two cameras report goes in, joint commands go out, and all of it is recorded.

In: a :class:`~armsight.loop.running.setup.Setup`, real or simulated. ``loop.py`` runs a controller (``controllers.py``:
open loop, closed on vision) and appends to a log (``log.py``), whose memory is bounded; ``calibrate.py`` moves the arm to
find mounting, delay and shutters; ``data.py`` has what is published meanwhile.
"""
