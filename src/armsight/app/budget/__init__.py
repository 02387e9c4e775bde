"""``armsight budget``: what a rig will measure before it is bought, what limits it, and what would make it better."""
