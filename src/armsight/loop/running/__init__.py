"""The control loop: what a board and two cameras report goes in, joint commands go out, and all of it is recorded."""
