"""The servo bus of the SO-100 and SO-101: five STS3215 servos of an arm and one of its gripper on one half-duplex wire.

In: :class:`~armsight.data.JointCommand`. Out: :class:`~armsight.data.JointStates`, and load, voltage, temperature.

- ``packets``: the bytes of protocol 0; ``registers``: addresses and what their numbers mean;
- ``bus``: questions and answers, and what is wrong with a bus that does not answer;
- ``board``: an arm on the bus behind :class:`~armsight.robot.boards.contract.MotionBoard`;
- ``calibration``: LeRobot's calibration file; ``offsets``: the homing offsets on the servos.
"""
