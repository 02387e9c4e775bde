"""Marker families: a grey image goes in, the places of a body's points come out. The contract is in ``marker.py``."""
