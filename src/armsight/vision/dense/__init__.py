"""Dense stereo: a rectified pair goes in, a disparity for every pixel of the left image comes out.

The contract is :class:`~armsight.vision.dense.method.Method` in ``method.py``; ``methods.py`` is the registry.

- The methods: ``block.py`` (windows), ``scanline.py`` (dynamic programming),
  ``semiglobal.py``, ``opencv.py``. What they share: ``cost.py`` (matching costs), ``winner.py`` (the least total),
  ``postprocess.py`` (rejection, smoothing, filling, sigma).
- Before and after: ``rectified.py`` (checks of a pair), ``depth.py`` (depth with its standard deviation).
- ``evaluate.py`` and ``middlebury.py``: errors against a true disparity map, and the benchmark's files.
"""
