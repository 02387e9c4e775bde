"""Boards: joint commands go out, what the joints do comes back.

In: a board's name (``emulated:unicorn``, ``emulated:qemu``, ``emulated:host``, ``serial:PORT``, ``feetech:PORT``,
``ar4:PORT``) and :class:`JointCommand`. Out: :class:`JointStates` and what the board says of itself.

- ``contract``: what every board does, and says that it cannot do;
- ``board``: the host's end of our firmware, :class:`~armsight.robot.boards.board.Board`;
- ``feetech``, ``ar4``: arms that keep their own controller;
- ``wire``: messages over a link; ``codes``, ``configuration``, ``reports``: what their numbers mean;
- ``link``: the contracts of a link, of an emulator and of the plant at an emulated board's motors;
- ``serial``: the link to a real board; ``emulated``: the link to an emulated one, ``frames`` its memory layout;
- ``emulators``: what runs the firmware on this computer.
"""
