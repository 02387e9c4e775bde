"""``armsight replay``: measuring and the estimators again, on what was recorded.

In: the folder of a run or its run.mcap, or a recording of ROS or Foxglove. Out: a folder with the tables of what came out
this time, compared with others (``tables.py``). ``recorded.py`` reads run.mcap, ``run.py`` runs again.
"""
