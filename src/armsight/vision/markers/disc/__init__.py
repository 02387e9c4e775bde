"""Plain discs: a grey image goes in, the ellipses' centres with their covariance come out, raw pixels.

``search.py``: where discs may be, and the start of each fit. ``fit.py``: the fit of one disc, its covariance, and tests
that reject what is not a disc. Which disc of the body each one is: :mod:`armsight.vision.discs`.
"""
