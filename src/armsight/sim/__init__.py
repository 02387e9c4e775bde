"""Simulation: rendered images, recordings and a whole workcell, each with its true values. Never imported by loop.

In: a seed, cameras, an arm. Out: what real devices would give (images, shots, a board), and beside it the truth, which
only evaluation may read.

- ``render/``: images of flat patterns and solid bodies through the full camera model;
- ``camera/``: lens, sensor and image processing between that light and the file;
- ``recording``: folders of rendered pairs with ``truth.json``; ``example_rig``: a test rig, its poses and its recordings;
- ``workcell/``: an arm with motors, an emulated board, two cameras and a body on the tool;
- ``joints``: six independent joints, the simplest plant behind a board.
"""
