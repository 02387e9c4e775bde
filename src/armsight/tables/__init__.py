"""People's numbers: files and tables of other programs go in, plain names, numbers and lengths in metres come out.

``yaml_file.py`` reads YAML as the programs of the field write it; ``lengths.py`` says whether a length can be one, and in
which unit it would be.
"""
