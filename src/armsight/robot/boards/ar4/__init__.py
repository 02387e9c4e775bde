"""An Annin AR4 behind the Teensy firmware of ar4_ros_driver: six steppers with encoders on the motors.

In: :class:`~armsight.data.JointCommand`. Out: :class:`~armsight.data.JointStates`.

- ``lines``: the lines of text of its protocol; ``models``: what differs from mk1 to mk3;
- ``board``: an arm behind :class:`~armsight.robot.boards.contract.MotionBoard`.
"""
