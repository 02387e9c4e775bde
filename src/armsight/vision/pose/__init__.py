"""Poses: detections of both cameras go in, the pose of what they see with its covariance comes out.

- ``measure.py`` is the whole of it: images to poses. ``locate.py``: a body from its points;
  ``assign.py``: which of several bodies; ``pnp.py``: a first pose.
- ``projection.py``, ``bundle.py``, ``posefit.py``: the reprojection errors that are minimised, of many shots and of one.
- ``predict.py``: how well a body can be measured before it is printed; ``noise.py``: what the residuals of many poses
  show; ``shutter.py``: when the rows of both cameras are exposed.

Folders below (``markers``, ``discs``) never import this one.
"""
