"""Other readings of the numbers of a table: what they would be if something about it were other than was said.

In: a table of poses. Out: its poses read in other ways, and what each would mean. Which of them is true is for the
subject's own closed form to say: the one that makes its data fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.tables.poses import PoseTable, stacked
from armsight.tables.rotations import CONVENTIONS, rotations_by


class Misread(NamedTuple):
    """The poses of a table read in another way.

    Attributes:
        kind: what is other; of two tables of one program both may be.
        Ts: (N, 4, 4) the poses then, m.
        said: what it would mean, and what to do.
        path: the table's file.
    """

    kind: str
    Ts: Array
    said: str
    path: Path


def misreadings(table: PoseTable, rows: NDArray[np.int64], Ts: Array, option: str) -> Iterator[Misread]:
    """Yield other readings of rows of a table.

    Args:
        table: the table.
        rows: (N,) which of its rows.
        Ts: (N, 4, 4) their poses as they were read, m.
        option: what stands before the names of the options of this table: "" or "seen-".
    """
    R, p = Ts[:, :3, :3], Ts[:, :3, 3]
    for kind, rotated, said in _rotations(table, rows, R, option):
        yield Misread(kind, stacked(rotated, p), said, table.path)
    exchanged = _exchanged(table, rows)
    if exchanged is not None:
        name = "seen:" if option else ""
        yield Misread(
            "order",
            exchanged,
            f"the rotation comes before the position: name the columns in their order, --columns {name}rx,ry,rz,x,y,z",
            table.path,
        )
    for named, position in _axes(p):
        said = f"the axes of the positions are not those of the rotations: the positions fit as {named}"
        yield Misread(f"axes {named}", stacked(R, position), said, table.path)


def _exchanged(table: PoseTable, rows: NDArray[np.int64]) -> Array | None:
    """Return poses (N, 4, 4) whose first three numbers are the rotation; None where a row is no six numbers."""
    written = table.written[rows]
    if written.shape[1] != 6:
        return None
    first = written[:, :3]
    degrees = np.degrees(first) if (np.abs(first) <= 2 * np.pi + 1e-3).all() else first
    return stacked(rotations_by(degrees, table.convention, table.path), table.unit_m * written[:, 3:])


def _rotations(table: PoseTable, rows: NDArray[np.int64], R: Array, option: str) -> Iterator[tuple[str, Array, str]]:
    """Yield other readings of a table's rotations (N, 3, 3), their kind, and what they would mean."""
    numbers = table.numbers[rows]
    width = numbers.shape[1]
    for convention in CONVENTIONS if width else ():
        if convention != table.convention and width == (4 if convention in ("wxyz", "xyzw") else 3):
            yield (
                f"convention {convention}",
                rotations_by(numbers, convention, table.path),
                f"the rotations are {convention}, not {table.convention}: --{option}rotation {convention}, or exchange the "
                "columns' names where they have any",
            )
    if width == 3:
        for unit, other, given in (
            (np.degrees(numbers), "radians", "degrees"),
            (np.radians(numbers), "degrees", "radians"),
        ):
            yield (
                other,
                rotations_by(unit, table.convention, table.path),
                f"the rotations are in {other}, not {given}: name the columns rx_{other[:3]} ry_{other[:3]} rz_{other[:3]}",
            )
        yield (
            "x and z",
            rotations_by(numbers[:, ::-1], table.convention, table.path),
            "the rotations about x and z are exchanged: KUKA's A is about z, Fanuc's W about x: exchange the names of the "
            "first and the last angle",
        )
    yield (
        "inverse",
        np.swapaxes(R, 1, 2),
        "the rotations are inverse (matrices column by column, or quaternions conjugate), the positions are not",
    )


def _axes(position: Array) -> Iterator[tuple[str, Array]]:
    """Yield positions (N, 3) with axes exchanged and mirrored, and how they are named."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        if order != (0, 1, 2) or min(signs) < 0:
            named = ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[k]}" for k, sign in zip(order, signs, strict=True))
            yield named, position[:, order] * signs
