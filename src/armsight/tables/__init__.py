"""People's numbers: files and tables of other programs go in, plain names, numbers and lengths in metres come out.

``yaml_file.py`` reads YAML as the programs of the field write it, ``document.py`` files of names and values; ``lengths.py``
says whether a length can be one, and in which unit it would be. Tables of poses and joints: ``cells.py`` makes rows of
cells of any file, with ``programs.py`` (robots' controllers) and ``documents.py`` (YAML, JSON); ``columns.py`` says what
the columns are, ``rotations.py`` what their numbers mean; ``poses.py`` has the poses, ``misread.py`` what else they could
be.
"""
