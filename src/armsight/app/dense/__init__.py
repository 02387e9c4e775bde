"""``armsight dense``: a disparity, and with a rig a depth, for every pixel; and the evaluation of the methods."""
