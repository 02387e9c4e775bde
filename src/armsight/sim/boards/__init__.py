"""Emulated controllers of arms that are bought, with the faults of their mechanics: bytes in, bytes out.

- ``device``: what an emulated controller is, and how it is reached: in step, or at a pseudo-terminal in real time;
- ``so101``: the servo bus of an SO-101; ``ar4``: the Teensy of an AR4;
"""
