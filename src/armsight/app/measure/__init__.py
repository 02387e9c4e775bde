"""``armsight measure``: a rig and shots of a target in; the target's pose shot by shot out, with its uncertainty.

``run.py`` measures shot after shot and prints the lines. ``poses.py`` has a shot's pose as a record, as JSON and as a line
of CSV. For ``--view``, ``view.py`` writes a folder of pictures, ``picture.py`` one shot with its residuals, ``chart.py``
the whole run over time.
"""
