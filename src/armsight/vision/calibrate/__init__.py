"""Calibration: detections of pairs of images go in, a rig with its covariance and held-out errors comes out.

``images.py`` calibrates cameras from the images of a source, ``boards.py`` from detections of a board, ``bodies.py`` the
relative pose of known cameras from a known body; all return a :class:`~armsight.vision.calibrate.result.Calibration`.

- ``start.py``: focal lengths and poses from nothing. ``screen.py``: robust rejection of gross errors.
- ``motion.py``: motion of the board between the two exposures of a pair.
- ``heldout.py``: errors on pairs that were left out of the fit. ``weak.py``: weaknesses of a calibration, with advice.
"""

#: Distortion models tried, simplest first.
MODELS = ("brown4", "brown5", "brown8", "fisheye")
#: Parts of the pairs, each of which is held out of a fit to the others.
FOLDS = 5
