"""``armsight serve``: keep ``armsight measure`` going for days.

In: a file with the command's options. Out: a child process that is started again whenever it ends because a
camera was lost; its shots on ``/metrics``, its state on ``/healthz``, a log that does not grow.

- ``config.py``: the file. ``service.py``: the child, and what is known of it. ``page.py``: the two pages.
"""
