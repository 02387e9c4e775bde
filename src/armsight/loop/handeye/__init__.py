"""Hand-eye calibration: where the cameras, or the markers, are to the arm."""
