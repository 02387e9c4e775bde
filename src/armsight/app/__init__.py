"""The command line: each command is the folder of its name, with the click command in its ``command.py``.

``main.py`` is the group. ``report/`` holds what all reports share, ``progress.py`` the progress bars; ``interrupts.py``
delays Ctrl-C until something is complete.
"""
