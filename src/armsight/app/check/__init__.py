"""``armsight check``: evaluate an arm by ISO 9283 and ISO 230-4, or plan the motions of such a test.

In: a run's folder or a CSV of attained poses. Out: metrics of poses, distance, paths, drift and a circle, as text, JSON and
a report.

- ``command``: the command line, ``armsight check RUN`` and ``armsight check plan``.
- ``rows``: one attained pose a row, and the CSV of rows.
- ``run_folder``: a run's folder to rows.
- ``evaluate``: rows to metrics; ``result``: the records that hold the metrics, and their JSON.
- ``report``: metrics as text, figures and an HTML page.
- ``plan``: poses, line and circle of a test as a motion file.
"""

#: Test -> how many cycles it has unless asked otherwise.
CYCLES = {"poses": 30, "wide": 1, "line": 10, "circle": 3}
#: Test -> how many cycles ISO 9283 requires.
REQUIRED_CYCLES = {"poses": 30, "line": 10}
#: The first pose must have been attained this many times for its drift.
DRIFT_CYCLES = 10
