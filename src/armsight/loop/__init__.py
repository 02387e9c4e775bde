"""Where vision and robot meet: hand-eye, identification of the arm, what a robot is judged by. Never imports sim."""
