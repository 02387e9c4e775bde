"""People's numbers: files and tables of other programs go in, plain names, numbers and lengths in metres come out.

``number.py`` is the number parser, ``lengths.py`` says whether a length can be one, ``document.py`` reads files of names
and values in any syntax (YAML, JSON, TOML, ..). Tables: ``cells.py`` makes rows of cells of any file, with ``programs.py``
(robots' controllers), ``capture.py`` (motion capture) and ``nested.py`` (poses in documents); ``columns.py`` says what
the columns are and gives their numbers, ``rotations.py`` what those mean; ``poses.py`` has the poses, ``misread.py`` what
else they could be.
"""
