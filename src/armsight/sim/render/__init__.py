"""Rendering: 8-bit images of flat patterns on bodies through the full camera model, exact in area.

In: cameras, bodies with patterns, a background, lens, sensor and shutter. Out: images (H, W) uint8, with known poses.

- ``scene``: patterns (grids of cells, discs: boards, tags, plates) on posed bodies; ``background``: what is behind them;
- ``paint``: the compiled painter of cells and discs; ``faces``: all patterns of one exposure over an image with depths;
- ``optics``: the lens's blur, shading, noise, rounding; ``render``: one image, or a pair, from these parts.
"""
