"""``armsight handeye``: hand-eye calibration of anyone's data.

In: a table of robot poses (or of joint angles and a model), and images of a target or a table of its poses. Out: both
transforms with sigma, the error of poses left out, whose error it is, blunders, the poses to take next, a page.

- ``read``: tables of poses, and what their numbers mean.
- ``images``: images to poses of the target, by one camera or a rig.
- ``recording``: both sides brought together, row by row or as streams.
- ``suspect``: what is wrong with data that do not fit.
- ``plan``: the poses to take next.
- ``result``: the text and the JSON of a calibration; ``report``: its page.
"""
