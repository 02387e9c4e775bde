"""``armsight identify``: kinematic identification of an arm, and the choice of poses for it.

In: a nominal arm and a CSV of joint angles with measured tool poses (docs/howto/identify.md). Out: the corrected arm as
TOML and URDF, the joint zeros, all parameters with sigmas, JSON and a report.

- ``command``: the command line, ``armsight identify`` and ``armsight identify plan``.
- ``run``: one identification from poses to files, and its text.
- ``report``: figures and the HTML page.
- ``plan``: the most informative next poses, of those that the arm reaches and both cameras see.
"""
