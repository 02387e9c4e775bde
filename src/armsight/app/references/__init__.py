"""``armsight references``: sensors beside vision, checked and calibrated from their files."""
