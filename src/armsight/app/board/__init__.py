"""``armsight board``: build and flash the firmware, watch a board, tune its gains, test it.

In: a board (emulated or at a serial port). Out: its state and gains as JSON and text, firmware images, the result of the
self-test.
"""
