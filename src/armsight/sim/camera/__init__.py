"""A camera between light and file: lens, sensor and image processing as a chain of optional stages.

In: linear radiance (H, W) as ``render`` makes it, the time, a seed. Out: the 8-bit image that a program gets.

- ``stages``: the parameters of each stage, their ranges, and the TOML file that holds them; ``presets/``: such files;
- ``pipeline``: :class:`~armsight.sim.camera.pipeline.SimulatedCamera`, which applies them in their physical order.
"""
