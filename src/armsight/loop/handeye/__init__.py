"""Hand-eye calibration: where the cameras, or the markers, are to the arm.

In: poses of the flange in the base (from the joints) and of a marker body in the rig (from vision). Out: the two constant
transforms with covariance and held-out error.

- ``handeye``: from pairs of poses, A X = Z B; :class:`~armsight.loop.handeye.handeye.HandEye`.
- ``sources``: whose errors they are, and which poses share them.
- ``streams``: from two streams of poses whose clocks differ by an unknown offset.
- ``pivot``: the tip of a tool, from rotating it about its tip.
"""
