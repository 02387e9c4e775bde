"""``armsight hub``: what the cells of a site send, on one page and in files.

In: states, events and liveliness of cells, over zenoh (``app/stream/cell.py`` sends them). Out: a page, metrics, a
database of events, Parquet tables of states; the keys of a site; pushed archives.
"""
