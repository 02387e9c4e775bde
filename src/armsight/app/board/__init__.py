"""``armsight board``: build and flash the firmware, watch a board, tune its gains, test it.

In: a board (emulated or at a serial port). Out: its state and gains as JSON and text, firmware images, the result of the
self-test.

- ``command``: the command line.
- ``text``: what is printed, as JSON and as text.
- ``flash``: a board's image, and the programmers that write it.
- ``selftest``: all scenarios on a board, and the test rig that they use.
"""
