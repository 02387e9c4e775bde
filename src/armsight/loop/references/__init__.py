"""References beside vision: sensors that measure something of the tool's motion, each one a member of one family.

In: readings of a sensor and the tool's motion. Out: what the sensor would read there, with derivatives, so that one filter
and one calibration serve them all (:mod:`~armsight.loop.references.reference`, :mod:`~armsight.loop.references.calibrate`).
"""
