"""Vision: two simultaneous images of a body with markers go in, the pose of the body with its covariance comes out.

The stages, in order: ``sources/`` (shots), ``markers/`` (detections), ``match.py``, ``triangulate.py``, ``pose/``
(runs them all on one shot), ``follow/`` from shot to shot. ``discs/`` identifies plain discs.

- The rig: ``camera.py``, ``rig.py``, ``camera_file.py``, ``rigfiles/`` (other programs' files), ``rectify.py``.
- ``calibrate/``: both cameras from boards or bodies, on ``pose/bundle.py``.
- ``dense/``: a disparity for every pixel.
"""
