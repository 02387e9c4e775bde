"""Calibration of two cameras: board images or a known body's detections in, a StereoRig and its held-out errors out."""
