"""``armsight measure``: a rig and shots of a target in; the target's pose shot by shot out, with its uncertainty.

``shots.py`` opens what is measured, ``run.py`` measures shot after shot and prints the lines, ``moving.py`` is for cameras
that do not expose at one time. For ``--view``, ``view.py`` writes a folder of pictures, ``picture.py`` one shot with its
residuals, ``chart.py`` the whole run over time.
"""
