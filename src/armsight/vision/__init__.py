"""Pixels to where the marker body is: sources, markers, cameras, calibration, matching, triangulation, location."""
