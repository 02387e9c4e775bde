"""Boards: joint commands go out, what the joints do comes back."""
