"""How every result is shown.

In: a Report, made once by the command that found something. Out: text on the terminal, JSON, one HTML page with its
figures, and the exit code (``report.py``). Beneath it: the page's HTML and its folder (``page.py``), tables (``table.py``),
plots in one style (``plotting.py``), messages (``messages.py``).
"""
