"""What all reports share.

In: numbers, pictures, text. Out: one HTML page (``page.py``), tables on a page or in the terminal (``table.py``), and plots
in one style (``plotting.py``). The reports themselves are in the folders of their commands.
"""
