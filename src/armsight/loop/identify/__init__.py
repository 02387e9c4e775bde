"""Kinematic identification: what each number of an arm is, from joint angles and where its tool was measured.

In: the nominal :class:`~armsight.robot.kinematics.arm.Arm` and :class:`Measured` poses (``read`` reads a file). Out:
:class:`Identified`, every parameter with its sigma, and :class:`Corrected`, the arm in use.

    read -> misread -> placement -> observable -> fit -> selection -> identify -> corrected

``plan`` chooses the next poses to measure, ``validate`` evaluates on others. Equations: docs/howto/identify.md.
"""
