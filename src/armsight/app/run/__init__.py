"""``armsight run``: the experiment with an arm, a board and two cameras.

``experiment.py`` has the sequence; the control loop is in ``loop/running``. ``tracks.py`` makes the tracks of its log,
``metrics.py`` evaluates them, ``report.py`` says the result once for terminal, JSON and page (``figures.py``),
``folder.py`` writes all of it. ``logged.py``: an arm that another program moves.
"""
