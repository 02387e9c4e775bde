"""Other people's kinematics of the same arms, for tests and benchmarks: pinocchio, EAIK, roboticstoolbox.

For standard tables without base, tool or reversed joints, as all models are. A peer not installed raises ImportError.
"""

from __future__ import annotations

import numpy as np


class Pinocchio:
    """Forward kinematics and Jacobian of pinocchio (PyPI: pin)."""

    def __init__(self, arm):
        import pinocchio as pin

        self._pin, self._arm = pin, arm
        self.model = pin.Model()
        placement, parent = pin.SE3.Identity(), 0
        for i in range(6):
            parent = self.model.addJoint(parent, pin.JointModelRZ(), placement, f"joint{i + 1}")
            placement = pin.SE3(pin.utils.rotate("x", float(arm.alpha[i])), np.array([arm.a[i], 0.0, arm.d[i]]))
        self.tool = self.model.addFrame(pin.Frame("tool", parent, placement, pin.FrameType.OP_FRAME))
        self.data = self.model.createData()

    def forward(self, q):
        self._pin.forwardKinematics(self.model, self.data, q + self._arm.offset)
        return self._pin.updateFramePlacement(self.model, self.data, self.tool).homogeneous

    def jacobian(self, q, frame="base"):
        axes = self._pin.LOCAL_WORLD_ALIGNED if frame == "base" else self._pin.LOCAL
        return self._pin.computeFrameJacobian(self.model, self.data, q + self._arm.offset, self.tool, axes)

    def jacobian_rate(self, q, qd, frame="base"):
        axes = self._pin.LOCAL_WORLD_ALIGNED if frame == "base" else self._pin.LOCAL
        theta = q + self._arm.offset
        self._pin.computeJointJacobiansTimeVariation(self.model, self.data, theta, qd)
        self._pin.updateFramePlacement(self.model, self.data, self.tool)
        return self._pin.getFrameJacobianTimeVariation(self.model, self.data, self.tool, axes)


class Eaik:
    """Inverse kinematics of EAIK (PyPI: EAIK): subproblem decomposition in C++."""

    def __init__(self, arm):
        from eaik.IK_DH import DhRobot

        self._arm, self.robot = arm, DhRobot(np.array(arm.alpha), np.array(arm.a), np.array(arm.d))

    def inverse(self, T):
        """The joint angles (N, 6) that EAIK holds for exact, rad."""
        found = self.robot.IK(T)
        return np.array([q for q, least in zip(found.Q, found.is_LS, strict=True) if not least]).reshape(-1, 6) - (
            self._arm.offset
        )

    def inverse_batch(self, Ts):
        """The same for many poses in one call, one thread."""
        offset = self._arm.offset
        out = []
        for found in self.robot.IK_batched(list(Ts), 1):
            exact = [q for q, least in zip(found.Q, found.is_LS, strict=True) if not least]
            out.append(np.array(exact).reshape(-1, 6) - offset)
        return out


class Toolbox:
    """Forward kinematics, Jacobian and iterative inverse of roboticstoolbox (PyPI: roboticstoolbox-python)."""

    def __init__(self, arm):
        import roboticstoolbox as rtb

        rows = zip(arm.a, arm.d, arm.alpha, arm.offset, strict=True)
        self.robot = rtb.DHRobot([rtb.RevoluteDH(a=a, d=d, alpha=alpha, offset=o) for a, d, alpha, o in rows])

    def forward(self, q):
        return self.robot.fkine(q).A

    def jacobian(self, q):
        return self.robot.jacob0(q)

    def inverse(self, T):
        """One solution by the toolbox's own damped least squares."""
        return self.robot.ikine_LM(T)


def unmatched(arm, T, theirs, ours):
    """Rows of ``theirs`` (N, 6) that are no solution of ``ours``, a Solutions of the pose T.

    The error that a solution has in the pose moves its joints by that over the smallest singular value of the Jacobian.
    """
    out = []
    for q in theirs:
        q = (q + np.pi) % (2 * np.pi) - np.pi
        error = np.abs(arm.forward(q) - T).max() + 1e-15
        allowed = 1e-7 + 4 * error / max(np.linalg.svd(arm.jacobian(q))[1][-1], 1e-300)
        apart = np.abs((ours.q - q + np.pi) % (2 * np.pi) - np.pi).max(axis=1)
        if not (apart < min(allowed, 1.0)).any():
            out.append(q)
    return np.array(out).reshape(-1, 6)
