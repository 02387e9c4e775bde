"""Sensors beside vision, simulated with errors that no estimator here assumes.

In: the true poses of what carries the sensor. Out: what it would record.
"""
