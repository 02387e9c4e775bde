"""Arms from and to URDF.

- ``tree``: the arm's joints in a file; ``read``: their Denavit-Hartenberg table; ``write``: a file from a table.
"""
