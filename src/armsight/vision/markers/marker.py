"""The contract of a marker family: an image goes in, the places of a body's points come out.

To add a family: write one file with a class that fulfils :class:`Target`, and add one line to the registry in
``targets.py``. The laws in tests/vision/markers are parametrised over that registry, so the new member inherits them.
"""

from __future__ import annotations

from typing import Protocol

from armsight.data import Body, Detections, Image


class Target(Protocol):
    """A rigid body that can be found in an image."""

    @property
    def body(self) -> Body:
        """The points that can be found and where they sit on the body, m."""
        ...

    def detect(self, image: Image) -> Detections:
        """Find the body in one grey image.

        Args:
            image: (H, W) uint8.

        Returns:
            The points found: rows of ``body.points``, raw pixels ((0, 0) is the centre of the top-left pixel), and the
            covariance the image itself supports. Nothing found is ``Detections.none(reason)``, never an exception.
        """
        ...
