"""``armsight board``: build and flash the firmware, watch a board, tune its gains, test it."""
