"""Performance metrics of ISO 9283 (and of circles, ISO 230-4) for an arm that the cameras watch."""
