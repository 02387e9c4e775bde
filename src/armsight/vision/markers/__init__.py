"""Marker families: a grey image goes in, the detected points of a body come out, raw pixels with their covariance.

The contract is :class:`~armsight.vision.markers.marker.Target` in ``marker.py``; ``targets.py`` opens a target by its
spec or its file.

- Calibration boards: ``board.py`` (contract and registry), ``spec.py`` (parser), ``chessboard.py``, ``charuco.py``,
  ``circles.py`` (with ``circle_blobs.py`` and ``circle_grid.py``), ``aprilgrid.py``, and ``grid.py`` for what regular
  grids share.
- Bodies: ``body_file.py`` (file formats and checks), ``targets.py`` (all markers of a body), ``tag.py``,
  ``board_marker.py``, ``discs.py`` (plain discs; the search and the fit of one are in ``disc/``).
- Sub-pixel fits: ``corner.py`` with its kernels in ``crossing.py``; ``square.py`` for tags found by ``aruco.py``;
  ``normal.py`` of vision has the edge profile and the normal equations that they share.
"""
