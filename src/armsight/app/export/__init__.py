"""``armsight export``: a run in the form of other tools.

In: the folder of a run, or its run.mcap. Out: tables (``tables.py``: CSV, Parquet, TUM for evo), a compressed MCAP or a
ROS 2 bag (``bags.py``).
"""
