"""``armsight body``: assess a body before it is built, and draw its markers to scale.

In: a body file (docs/howto/targets.md) and, for the assessment, a stereo rig and distances. Out: findings with the
predicted covariance of the pose; drawings as PDF, SVG or PNG.

- ``command``: the command line, ``armsight body check`` and ``armsight body draw``.
- ``check``: overlaps, sizes, visibility, the predicted pose, and ambiguities of discs.
- ``finding``: the records of an assessment, and the text for ambiguities and axes.
- ``draw``: one page for each plane of the body.
"""
