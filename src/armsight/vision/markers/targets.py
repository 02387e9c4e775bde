"""What the user names on the command line, a board's spec or a body's file, becomes a Target or a Body."""

from __future__ import annotations

from armsight.data import Body
from armsight.vision.markers.board import open_board
from armsight.vision.markers.marker import Target


def open_target(spec: str) -> Target:
    """Make the target of a board spec."""
    return open_board(spec)


def open_body(spec: str) -> Body:
    """Return the body of a board spec."""
    return open_target(spec).body
