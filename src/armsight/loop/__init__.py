"""The closed loop: what needs both vision and robot.

- ``running``: the control loop, what it finds by moving the arm, and its log.
- ``servo``: the outer loop, from a motion and an estimate to the next joint command.
- ``estimators``: the tool's pose at 1 kHz, from potentiometers and vision.
- ``delay``: how late the camera's stamps are.
- ``finding``: what no longer holds; ``health`` finds it.
- ``handeye``: where cameras and markers are to the arm.
- ``identify``: kinematic identification of the arm, and the poses to measure next.
- ``iso9283``: performance metrics of the arm.

Imports vision, robot and geometry, never sim.
"""
