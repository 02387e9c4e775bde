"""The markers of a body by kind: a body file goes in; discs, tags, boards and the normal at each point come out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from armsight.data import Array, Body, Record
from armsight.errors import InputError
from armsight.vision.markers.board_marker import BoardTarget, check_codes
from armsight.vision.markers.body_file import check_points, read_body_file
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.tag import TagTarget

KINDS = ("disc", "tag", "board")


@dataclass(frozen=True, eq=False)
class Layout(Record):
    """The markers of a body by kind.

    Attributes:
        name: what the body is called.
        discs: its discs, or None.
        tags: its tags, or None.
        boards: its boards, or None.
    """

    name: str
    discs: DiscTarget | None
    tags: TagTarget | None
    boards: BoardTarget | None

    @cached_property
    def body(self) -> Body:
        """All points: discs first, then the corners of tags and of boards."""
        bodies = [part.body for part in (self.discs, self.tags, self.boards) if part is not None]
        names = tuple(name for body in bodies for name in body.point_names)
        return Body(self.name, names, np.concatenate([body.points for body in bodies]))

    @cached_property
    def normals(self) -> Array:
        """(M, 3) unit vectors out of the face of each point; NaN where the file does not give it."""
        rows = [] if self.discs is None else [self.discs.normals]
        rows += [] if self.tags is None else [np.tile(-tag.T_body_tag[:3, 2], (4, 1)) for tag in self.tags.tags]
        if self.boards is not None:
            for mounted in self.boards.boards:
                rows.append(np.tile(mounted.normal, (len(mounted.board.body.points), 1)))
        return np.concatenate(rows)

    @property
    def disc_count(self) -> int:
        """How many discs there are; they are the first points."""
        return 0 if self.discs is None else len(self.discs.radii_m)

    @property
    def coded(self) -> bool:
        """Whether a tag or a board identifies the body and its orientation."""
        return self.tags is not None or self.boards is not None


def read_layout(path: str | Path) -> Layout:
    """Read a body file.

    Raises:
        InputError: missing, malformed, no TOML body, or a body that no command accepts (``check_points``).
    """
    if Path(path).suffix.lower() != ".toml":
        raise InputError(f"{path}: expected a TOML body file, which describes its markers (docs/howto/targets.md)")
    name, markers = read_body_file(path, KINDS)
    of = {kind: [marker for marker in markers if marker.kind == kind] for kind in KINDS}
    layout = Layout(
        name,
        DiscTarget.from_markers(name, of["disc"]) if of["disc"] else None,
        TagTarget.from_markers(name, of["tag"]) if of["tag"] else None,
        BoardTarget.from_markers(name, of["board"]) if of["board"] else None,
    )
    check_points(path, layout.body)
    check_codes(of["tag"], of["board"])
    return layout
