"""``armsight record``: shots of two cameras in, a folder of PNG images with an index out (``recording.py``).

The folder is a source itself: every other command reads it as live cameras.
"""
