"""Pose <-> joints: arms from their tables. Never imports vision."""
