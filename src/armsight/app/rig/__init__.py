"""``armsight rig``: shows a rig file, and converts rigs of other programs (OpenCV, ROS, Kalibr) from and to it."""
