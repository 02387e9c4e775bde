"""
Print the plate
===============

Write the plate of an arm's page, and the block between it and the gripper, as STL (mm) for a 3D printer.

.. code-block:: console

    $ python examples/08_plate_to_print.py

Two screws M3 x 22 go through the block from behind and cut their thread in the plate; the print of ``armsight body draw``
is glued over them. Change the numbers, and run it again.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial import Delaunay

#: Width, height and thickness, mm; diameters of the holes; distance of the two holes.
PLATE, PLATE_HOLE = (90.0, 90.0, 3.0), 2.5
BLOCK, BLOCK_HOLE = (32.0, 12.0, 20.0), 3.2
APART, SIDES = 20.0, 48


def prism(size: tuple[float, float, float], hole: float) -> np.ndarray:
    """Return the triangles (N, 3, 3) of a box about the origin, on z = 0, with two round holes."""
    width, height, thickness = size
    angle = np.arange(SIDES) * 2 * np.pi / SIDES
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]
    centres = np.array([[-APART / 2, 0], [APART / 2, 0]])
    round_ = hole / 2 * np.column_stack([np.cos(angle), np.sin(angle)])
    walls = [corners, *(centre + round_[::-1] for centre in centres)]  # a hole's wall faces inwards
    points = np.concatenate(walls)
    faces = points[Delaunay(points).simplices]
    middle = faces.mean(axis=1)
    faces = faces[(np.linalg.norm(middle[:, None] - centres, axis=2) > hole / 2 * np.cos(np.pi / SIDES)).all(axis=1)]
    (ax, ay), (bx, by) = (faces[:, 1] - faces[:, 0]).T, (faces[:, 2] - faces[:, 0]).T
    faces[ax * by < ay * bx] = faces[ax * by < ay * bx][:, ::-1]  # anticlockwise from above
    bottom, top = (np.dstack([faces, np.full(faces.shape[:2], z)]) for z in (0.0, thickness))
    found = [bottom[:, ::-1], top]
    for wall in walls:
        a, b = (np.column_stack([each, np.zeros(len(each))]) for each in (wall, np.roll(wall, -1, axis=0)))
        up = np.array([0.0, 0.0, thickness])
        found += [np.stack([a, b, b + up], axis=1), np.stack([a, b + up, a + up], axis=1)]
    return np.concatenate(found)


def main(folder: Path) -> np.ndarray:
    """Write ``plate.stl``, both parts side by side; return its triangles (N, 3, 3), mm."""
    beside = [0.0, (PLATE[1] + BLOCK[1]) / 2 + 10.0, 0.0]
    triangles = np.concatenate([prism(PLATE, PLATE_HOLE), prism(BLOCK, BLOCK_HOLE) + beside])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("colour", "<u2")])
    rows["normal"], rows["corners"] = normals, triangles
    file = folder / "plate.stl"
    file.write_bytes(bytes(80) + np.uint32(len(rows)).tobytes() + rows.tobytes())
    print(
        f"{file}: plate {PLATE[0]:g} x {PLATE[1]:g} x {PLATE[2]:g} mm, block {BLOCK[0]:g} x {BLOCK[1]:g} x {BLOCK[2]:g} mm"
    )
    return triangles


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path())
