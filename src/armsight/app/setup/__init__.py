"""``armsight setup``: walk through the page of an arm in the terminal."""
