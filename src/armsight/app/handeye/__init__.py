"""``armsight handeye``: hand-eye calibration of anyone's data."""
