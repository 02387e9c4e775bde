"""``armsight export``: a run in the form of other tools."""
