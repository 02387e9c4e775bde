"""Other readings of the numbers of a table: what they would be if something about it were other than was said."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.geometry.pose import pose
from armsight.tables.poses import PoseTable
from armsight.tables.rotations import CONVENTIONS, rotations_by


class Misread(NamedTuple):
    """The poses of a table read in another way."""

    kind: str  #: what is other; of two tables of one program both may be
    Ts: Array  #: (N, 4, 4) the poses then, m
    said: str  #: what it would mean, and what to do
    path: Path  #: the table's file


def misreadings(table: PoseTable, rows: NDArray[np.int64], Ts: Array, option: str) -> Iterator[Misread]:
    """Yield other readings of rows of a table.

    Args:
        table: the table.
        rows: (N,) which of its rows.
        Ts: (N, 4, 4) their poses as they were read, m.
        option: what stands before what --columns says of this table: "" or "seen:".
    """
    R, p, width, given = Ts[:, :3, :3], Ts[:, :3, 3], table.numbers.shape[1], table.convention
    numbers = table.numbers[rows] if width else table.numbers
    rotated: list[tuple[str, Array, str, str]] = [
        (
            f"convention {convention}",
            numbers,
            convention,
            f"the rotations are {convention}, not {given}: --columns {option}rotation={convention}, or exchange the "
            "columns' names where they have any",
        )
        for convention in CONVENTIONS
        if width == (4 if convention in ("wxyz", "xyzw") else 3) and convention != given
    ]
    if width == 3:
        for unit, other, instead in (
            (np.degrees(numbers), "radians", "degrees"),
            (np.radians(numbers), "degrees", "radians"),
        ):
            names = " ".join(f"r{axis}_{other[:3]}" for axis in "xyz")
            said = f"the rotations are in {other}, not {instead}: name the columns {names}"
            rotated.append((other, unit, given, said))
        said = (
            "the rotations about x and z are exchanged: KUKA's A is about z, Fanuc's W about x: exchange the names of "
        )
        rotated.append(("x and z", numbers[:, ::-1], given, f"{said}the first and the last angle"))
        if given != "ZYZ":  # Doosan's A, B, C read as KUKA's
            said = f"the rotations are ZYZ, not {given}: --columns {option}rotation=ZYZ"
            rotated.append(("ZYZ", numbers[:, ::-1], "ZYZ", said))
    for kind, read, convention, said in rotated:
        yield Misread(kind, pose(rotations_by(read, convention, table.path), p), said, table.path)
    said = "the rotations are inverse (matrices column by column, or quaternions conjugate), the positions are not"
    yield Misread("inverse", pose(np.swapaxes(R, 1, 2), p), said, table.path)
    if table.written.shape[1] == 6:  # the first three numbers may be the rotation
        first, last = np.hsplit(table.written[rows], 2)
        degrees = np.degrees(first) if (np.abs(first) <= 2 * np.pi + 1e-3).all() else first
        columns = f"--columns {option}rx,ry,rz,x,y,z"
        said = f"the rotation comes before the position: name the columns in their order, {columns}"
        yield Misread("order", pose(rotations_by(degrees, given, table.path), table.unit_m * last), said, table.path)
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        if order != (0, 1, 2) or min(signs) < 0:
            named = ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[k]}" for k, sign in zip(order, signs, strict=True))
            said = f"the axes of the positions are not those of the rotations: the positions fit as {named}"
            yield Misread(f"axes {named}", pose(R, p[:, order] * signs), said, table.path)
