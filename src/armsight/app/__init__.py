"""The command line: each command is the folder of its name, with the click command in its ``command.py``.

A ``command.py`` has the options and the help; its functions import what does the work when they are called, so that ``-h``,
mistakes in the options and the completion of a shell import neither numpy nor OpenCV. Constants that options show stand in
light modules, most of them in the ``__init__.py`` of their package.

``main.py`` is the group, ``show/`` how every result is shown; ``interrupts.py`` delays Ctrl-C until something is
complete.
"""
