"""Kinds of sources and boards that commands open themselves, beside those of vision's sources and robot's boards."""

#: The simulated workcell.
SIM = "sim:"
#: A file of what was detected in images, or bag:FILE for tags in a recording.
DETECTIONS = "detections:"
#: Joint angles that another program logged: ``--board poses:FILE``.
LOGGED = "poses:"
