"""Kinds of sources that commands open themselves, beside those of :mod:`armsight.vision.sources`."""

#: The simulated workcell.
SIM = "sim:"
#: A file of what was detected in images, or bag:FILE for tags in a recording.
DETECTIONS = "detections:"
