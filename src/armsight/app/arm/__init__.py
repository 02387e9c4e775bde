"""``armsight arm``: the kinematics of an arm at the command line."""
