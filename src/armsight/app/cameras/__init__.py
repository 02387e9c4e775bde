"""``armsight cameras``: lists the cameras of this computer with their modes, and what a problem with one may come from."""
