"""Boards as markers of a body: ``board = { spec = "chessboard:9x6:25mm" }``.

A marker's position is that of the board's first point, and its frame is oriented as every marker's: x along the
columns, y down, z into the face. (Kalibr's boards have y up and z out of the face: they are rotated by 180 degrees
about x.) Points are named after the marker and their name on the board: ``B.0``, ``B.1``, ...
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Record
from armsight.geometry.pose import transform
from armsight.vision.markers.aruco import APRILTAGS, tag_family
from armsight.vision.markers.board import open_board
from armsight.vision.markers.body_file import Marker
from armsight.vision.markers.marker import CalibrationBoard, Target, detect_parts

#: T_marker_board of a board whose y axis runs up and whose z axis points out of the face.
_ABOUT_X = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class MountedBoard(Record):
    """One board on a body: ``T_body_board`` (4, 4), m, and the ``normal`` (3,) out of its face, body frame."""

    name: str
    board: CalibrationBoard
    T_body_board: Array
    normal: Array


@dataclass(frozen=True, eq=False)
class BoardTarget(Record, Target):
    """A body found by its boards."""

    name: str
    boards: tuple[MountedBoard, ...]

    @staticmethod
    def from_markers(name: str, markers: Sequence[Marker]) -> BoardTarget:
        """Build the target from a body file's markers of kind ``board``.

        InputError: a malformed spec, a missing or unknown key, a board that looks the same when it is rotated, or two
        boards of one body that may be taken for one another.
        """
        boards: list[MountedBoard] = []
        for marker in markers:
            marker.check_keys("board", required=("spec",))
            board = open_board(marker.converted("spec", _checked))
            if board.symmetries:
                raise marker.error(
                    f"{board.body.name} looks the same when it is rotated, so its corners cannot be identified on a body: "
                    "use a chessboard whose columns + rows is odd, such as 9x6, a charuco board or an aprilgrid"
                )
            for other in boards:
                if _alike(board, other.board):
                    raise marker.error(
                        f"{board.body.name} may be taken for {other.name!r}, {other.board.body.name}: boards of one body "
                        "need to be of different kinds, and their tags of different families"
                    )
            T = marker.pose()
            boards.append(MountedBoard(marker.name, board, T @ _ABOUT_X if board.y_up else T, -T[:3, 2]))
        return BoardTarget(name, tuple(boards))

    @cached_property
    def body(self) -> Body:
        """The points of all boards, board by board."""
        names = tuple(f"{mounted.name}.{name}" for mounted in self.boards for name in mounted.board.body.point_names)
        points = [transform(mounted.T_body_board, mounted.board.body.points) for mounted in self.boards]
        return Body(self.name, names, np.concatenate(points))

    @cached_property
    def normals(self) -> Array:
        """(M, 3) unit vectors out of the face of each point, body frame."""
        return np.repeat([m.normal for m in self.boards], [len(m.board.body.points) for m in self.boards], axis=0)

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the boards in one grey image; see :class:`~armsight.vision.markers.marker.Target`."""
        return detect_parts(image, ((f"{mounted.name}: ", mounted.board) for mounted in self.boards))


def _checked(spec: str) -> str:
    open_board(spec)
    return spec


def check_codes(tags: Sequence[Marker], boards: Sequence[Marker]) -> None:
    """Reject a tag that is also on a board of the same body with InputError: it would be detected twice, ambiguously."""
    for entry in boards:
        family, ids = board_codes(open_board(entry.fields["spec"]))
        for tag in tags:
            if dictionary(tag_family(tag.fields["family"])) == family and tag.fields["id"] in ids:
                raise tag.error(
                    f"{tag.fields['family']} id {tag.fields['id']} is on the board {entry.name!r} too, which has ids "
                    f"{ids[0]} to {ids[-1]}: use another id or family"
                )


def board_codes(board: CalibrationBoard) -> tuple[str, range]:
    """Return the dictionary of a board's tags and their ids; an empty name and none where it has no tags."""
    family, ids = board.codes
    return dictionary(family), ids


def dictionary(family: str) -> str:
    """Return the one name of all families that hold the same tags: the first of DICT_4X4_100 are those of DICT_4X4_50."""
    return APRILTAGS.get(family, re.sub(r"(\dX\d)_\d+$", r"\1", family))


def _alike(one: CalibrationBoard, other: CalibrationBoard) -> bool:
    """Whether the finder of one board may find the other: common tags of a dictionary, or two of a kind without tags."""
    (family, ids), (family_other, ids_other) = board_codes(one), board_codes(other)
    if not (family or family_other):
        return type(one) is type(other)
    return family == family_other and bool(set(ids) & set(ids_other))
