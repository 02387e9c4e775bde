"""``armsight run``: the experiment with an arm, a board and two cameras.

In: devices (``setup.py``), a calibrated rig, a motion file (``motion_file.py``). Out: a folder of tracks with a report.

The sequence is in ``experiment.py``; it uses ``calibrate.py`` (hand-eye poses, delay), ``controllers.py`` (open loop and
closed on vision) and ``loop.py`` (the control loop). ``record.py`` has the log and the tracks; ``metrics.py`` evaluates the
tracks, ``summary.py`` has the result in numbers, ``report.py`` the page, ``folder.py`` writes all of it.
"""
