"""``armsight identify``: kinematic identification of an arm, and the choice of poses for it.

In: a nominal arm and a CSV of joint angles with measured tool poses (docs/howto/identify.md). Out: the corrected arm as
TOML and URDF, the joint zeros, all parameters with sigmas, JSON and a report.
"""
