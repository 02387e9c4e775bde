"""Kinematics as plain functions of (table, q), compiled by numba: no checks and no allocation; the checks are Arm's.

``table`` is the packed form of an arm that :func:`armsight.robot.kinematics.table.packed` makes.

numba's cache on disk looks at the age of a function's own file only: after a change to a file here, remove the cached
code of the files that call into it (``find src -name "*.nb[ci]" -delete``).
"""
