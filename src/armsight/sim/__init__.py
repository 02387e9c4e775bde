"""The world that stands in for the real one and knows the truth: rendered images and recordings."""
