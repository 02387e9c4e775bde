"""Open targets: a board's spec or a body file goes in, a Target to detect or a Body to measure against comes out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Record
from armsight.errors import InputError
from armsight.files import read_toml
from armsight.vision.markers.aprilgrid import AprilGrid
from armsight.vision.markers.board import BOARDS, KALIBR, open_board
from armsight.vision.markers.board_marker import BoardTarget, board_codes, check_codes, dictionary
from armsight.vision.markers.body_file import Marker, check_points, load_body_csv, read_body_file
from armsight.vision.markers.calibrated_board import EstimatedBoard, load_board_file
from armsight.vision.markers.charuco import Charuco
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.marker import Target, detect_parts
from armsight.vision.markers.tag import TagTarget

#: Kind of marker in a body file -> what makes a target of all markers of that kind on a body of a given name. Discs
#: carry no code, so one image cannot identify them: they are a kind of their own, :data:`DISC`.
MARKERS: dict[str, Callable[[str, Sequence[Marker]], Target]] = {
    "tag": TagTarget.from_markers,
    "board": BoardTarget.from_markers,
}

#: The kind of a plain disc in a body file.
DISC = "disc"
#: Bodies without codes whose distances differ by less than this, m, cannot be distinguished safely.
_SAME_M = 1e-3


@dataclass(frozen=True, eq=False)
class Composite(Record, Target):
    """A body that carries markers of several kinds: its points are those of its ``parts``, then of its ``discs``."""

    name: str
    parts: tuple[Target, ...]
    discs: DiscTarget | None = None

    @cached_property
    def body(self) -> Body:
        """All parts' points, then the discs' centres."""
        bodies = [part.body for part in self.parts] + ([] if self.discs is None else [self.discs.body])
        names = tuple(name for body in bodies for name in body.point_names)
        return Body(self.name, names, np.concatenate([body.points for body in bodies]))

    @cached_property
    def normals(self) -> Array:
        """(M, 3) unit vectors out of the face of each point, body frame; NaN where the file does not give it."""
        return np.concatenate([part.normals for part in (self.tags, self.boards, self.discs) if part is not None])

    @property
    def tags(self) -> TagTarget | None:
        """Its tags."""
        return next((part for part in self.parts if isinstance(part, TagTarget)), None)

    @property
    def boards(self) -> BoardTarget | None:
        """Its boards."""
        return next((part for part in self.parts if isinstance(part, BoardTarget)), None)

    @property
    def disc_count(self) -> int:
        """How many discs there are; they are the last points."""
        return 0 if self.discs is None else len(self.discs.radii_m)

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find every coded part in one grey image; discs are identified by both cameras together."""
        return detect_parts(
            image,
            (("", part) for part in self.parts),
            "plain discs carry no codes: one image alone cannot identify them",
        )


def read_layout(path: str | Path) -> Composite:
    """Read a body file; InputError names file and entry, also of a body that no command accepts (``check_points``)."""
    if Path(path).suffix.lower() != ".toml":
        raise InputError(f"{path}: expected a TOML body file of markers, not a board or points (docs/howto/targets.md)")
    name, markers = read_body_file(path, (*MARKERS, DISC))
    of_kind = {kind: [m for m in markers if m.kind == kind] for kind in (*MARKERS, DISC)}
    parts = tuple(make(name, of_kind[kind]) for kind, make in MARKERS.items() if of_kind[kind])
    body = Composite(name, parts, DiscTarget.from_markers(name, of_kind[DISC]) if of_kind[DISC] else None)
    check_points(path, body.body)
    check_codes(of_kind["tag"], of_kind["board"])
    return body


def open_target(spec: str | Path) -> Target:
    """Make a target that can be found in images.

    ``spec``: a board such as ``chessboard:9x6:25mm``, a TOML body file, or a TOML board file of ``calibrate``. Raises
    InputError: neither, malformed, or a CSV body, which has points but no description of its markers.
    """
    kind = _kind(spec := str(spec))
    if kind == ".csv":
        raise InputError(
            f"{spec}: a CSV body has points but no description of its markers, so it cannot be found in images; give "
            "--source detections:D.csv with it, or describe its markers in a TOML body file (docs/howto/targets.md)"
        )
    if kind == "board":
        return open_board(spec)
    if "board" in read_toml(spec):
        return load_board_file(spec)
    body = read_layout(spec)
    return body.parts[0] if len(body.parts) == 1 and body.discs is None else body


def open_fixed(specs: Sequence[str], target: str) -> tuple[Target, ...]:
    """Make the targets that do not move, beside the one that is measured.

    Raises InputError: as :func:`open_target`, or two are given of which one would be taken for the other.
    """
    opened = {f"--target {target}": open_target(target)} if specs else {}
    for spec in specs:
        if _kind(spec) == ".csv":
            raise InputError(f"--fixed {spec}: a CSV has points, not markers; describe them in a TOML body file")
        body = open_target(spec)
        for other, seen in opened.items():
            if alike := _alike(body, seen):
                raise InputError(
                    f"--fixed {spec} and {other} {alike}: a fixed body is another one, with markers of its own"
                )
        opened[f"--fixed {spec}"] = body
    return tuple(opened.values())[1:]


def _alike(target: Target, other: Target) -> str:
    """Return why one of two targets may be taken for the other; empty where neither can."""
    if both := _codes(target) & _codes(other):
        return "both have the marker {} {}".format(*min(both))
    apart, beside = (_distances(each.body.points) for each in (target, other))
    kinds = {type(each.drawing if isinstance(each, EstimatedBoard) else each) for each in (target, other)}
    coded = _codes(target) or _codes(other)
    same = (
        not coded
        and len(kinds) == 1
        and len(apart) == len(beside)
        and np.allclose(apart, beside, rtol=0.0, atol=_SAME_M)
    )
    return "have markers at the same distances" if same else ""


def _codes(target: Target) -> set[tuple[str, int]]:
    """Return family and number of every code on a target."""
    if isinstance(target, Composite):
        return set[tuple[str, int]]().union(*(_codes(part) for part in target.parts))
    if isinstance(target, TagTarget):
        return {(dictionary(tag.family), tag.identity) for tag in target.tags}
    if isinstance(target, BoardTarget):
        return set[tuple[str, int]]().union(*(_codes(mounted.board) for mounted in target.boards))
    if isinstance(target, EstimatedBoard):
        return _codes(target.drawing)
    if isinstance(target, AprilGrid | Charuco):
        family, ids = board_codes(target)
        return {(family, k) for k in ids}
    return set()


def _distances(points: Array) -> Array:
    """Return the distances between points (N, 3), each pair's twice, sorted."""
    return np.sort(np.concatenate([np.linalg.norm(points - each, axis=1) for each in points]))


def open_body(spec: str | Path) -> Body:
    """Return the body that a board's spec, a TOML body file or a CSV of points describes.

    Raises InputError: none of these, or malformed.
    """
    return load_body_csv(spec) if _kind(str(spec)) == ".csv" else open_target(spec).body


def _kind(spec: str) -> str:
    """Return ``board``, ``.toml`` or ``.csv``; Kalibr's target files are boards."""
    suffix = Path(spec).suffix.lower()
    if spec.strip().split(":")[0] in BOARDS or (":" in spec and not Path(spec).exists()) or suffix in KALIBR:
        return "board"
    if suffix in (".toml", ".csv"):
        return suffix
    raise InputError(
        f"{spec!r} is not a target: expected a board ({', '.join(BOARDS)}), a .toml body file, a .csv of points or "
        "Kalibr's .yaml of a target"
    )
