"""``armsight identify``: kinematic identification of an arm, and the choice of poses for it."""
