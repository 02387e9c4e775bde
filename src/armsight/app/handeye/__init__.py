"""``armsight handeye``: hand-eye calibration of anyone's data.

In: robot poses (or joint angles and a model), and images of a target or a table of its poses. Out: both transforms with
sigma, the error of poses left out, whose error it is, blunders, the poses to take next, a page.
"""
