"""Rotations, poses, rigid fits and array checks: numpy in, numpy out, no knowledge of cameras or robots."""
