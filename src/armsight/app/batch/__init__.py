"""``armsight batch``: one command on many recordings, on this machine's cores or on a Dask cluster.

In: paths with wildcards, also of s3:// and other stores that fsspec knows. Out: shots.parquet, one row a shot,
recordings.parquet, one row a recording, and batch.json, the version and the options. ``work.py`` is what runs for one
recording, ``run.py`` hands the recordings out and collects the results.
"""
