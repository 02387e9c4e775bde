"""Kinematic identification: what each number of an arm is, from joint angles and where its tool was measured.

In: the nominal :class:`~armsight.robot.kinematics.arm.Arm` and :class:`Measured` poses (``read`` reads a CSV file). Out:
:class:`Identified`, every parameter with its sigma, and :class:`Corrected`, the arm in use.

    measured -> diagnose -> placement -> observable -> fit -> selection -> identify -> corrected

``identify.identify`` runs the line on the parameters of ``model``. ``joint_noise`` and ``backlash`` estimate what scatters
from pose to pose, ``validate`` evaluates the result on other poses, ``plan`` chooses the next poses to measure. Equations
and formats: docs/howto/identify.md.
"""
