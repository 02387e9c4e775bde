"""``armsight serve``: keep ``armsight measure`` or ``armsight run`` going for days.

In: a file that names the command and its options. Out: a child process that is started again whenever it ends because a
camera or a board was lost; its shots on ``/metrics``, its state on ``/healthz``, a log that does not grow.

- ``config.py``: the file. ``service.py``: the child, and what is known of it. ``page.py``: the two pages.
"""
