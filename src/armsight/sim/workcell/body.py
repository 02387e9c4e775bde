"""The body on the tool: a plate with four wings that lean back, nine bright discs of three sizes on dark faces.

The wings put discs off the plate's plane and far from its middle, which makes its tilt observable; nothing hides anything
else as long as the cameras see the plate from within 30 degrees of its normal, and the three sizes distinguish discs.
x to the right, y down and z into the plate, as one looks at it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from armsight.data import Array, Body, Record
from armsight.errors import InputError
from armsight.geometry.pose import pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.sim.render.scene import Pattern, plate
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.targets import Composite

NAME = "tool_body"
DARK, BRIGHT = 0.06, 0.85
_LEAN_DEG = 30.0
Spot = tuple[str, float, float, float]


@dataclass(frozen=True, eq=False)
class _Face(Record):
    """One flat face: where it is on the body, its sides, m, and its discs: name, x, y and radius, m."""

    T_body_face: Array
    size_m: tuple[float, float]
    discs: tuple[Spot, ...]


def _wing(x: float, y: float, z: float, disc: Spot) -> _Face:
    """Return a wing at a position, mm, leaning away from the middle."""
    lean = np.radians(_LEAN_DEG) * np.array([np.sign(y), -np.sign(x), 0.0])
    return _Face(pose(exp_so3(lean), np.array([x, y, z]) * 1e-3), (0.046, 0.046), (disc,))


_FACES = (
    _Face(
        np.eye(4),
        (0.104, 0.104),
        (
            ("A", -0.034, -0.035, 0.0068),
            ("B", 0.036, -0.033, 0.0091),
            ("C", 0.034, 0.035, 0.0068),
            ("D", -0.033, 0.032, 0.0121),
            ("E", 0.004, -0.002, 0.0091),
        ),
    ),
    _wing(-78.0, 3.0, 14.0, ("F", 0.0, 0.0, 0.0091)),
    _wing(78.0, -4.0, 14.0, ("G", 0.0, 0.0, 0.0121)),
    _wing(-5.0, -78.0, 14.0, ("H", 0.0, 0.0, 0.0121)),
    _wing(4.0, 78.0, 14.0, ("I", 0.0, 0.0, 0.0068)),
)


def body_patterns() -> tuple[Pattern, ...]:
    """Return what the painter paints, one pattern for each face."""
    return tuple(
        plate(*face.size_m, DARK, [(x, y, radius, BRIGHT) for _, x, y, radius in face.discs]).on_body(face.T_body_face)
        for face in _FACES
    )


def patterns_of(target: Composite) -> tuple[Pattern, ...]:
    """Return what is painted of a body of discs, a plate for those of each face."""
    discs, own = target.discs, body_target().discs
    if discs is not None and own is not None and not target.parts and _alike(discs, own):
        return body_patterns()
    if discs is None or target.parts or np.isnan(discs.normals).any():
        raise InputError(f"{target.body.name}: simulated cameras show discs with normals, such as the demo's body.toml")
    offsets = np.sum(discs.normals * discs.body.points, axis=1)
    planes = np.unique(np.column_stack([discs.normals, offsets]).round(6), axis=0)
    found = []
    for *normal, offset in planes:
        face = np.flatnonzero(np.all(np.abs(discs.normals - normal) < 1e-5, axis=1) & (np.abs(offsets - offset) < 1e-5))
        points, radii, bright = discs.body.points[face], discs.radii_m[face], bool(discs.bright[face[0]])
        if len(other := face[discs.bright[face] != bright]):
            names = [discs.body.point_names[k] for k in (face[0], other[0])]
            raise InputError(
                f"{target.body.name}: {names[0]} and {names[1]} are on one face, and one of them is bright, one dark: "
                "simulated cameras show discs of one contrast on each face"
            )
        T = pose(Rotation.align_vectors(normal, (0.0, 0.0, -1.0))[0].as_matrix(), np.zeros(3))
        xy = points @ T[:3, :2]
        low, high = (f(xy + s * 1.5 * radii[:, None], axis=0) for f, s in ((np.min, -1), (np.max, 1)))
        T[:3, 3] = T[:3, :3] @ np.array([*(low + high) / 2, (points @ T[:3, 2]).mean()])
        spots = [(*(p - (low + high) / 2), r, BRIGHT if bright else DARK) for p, r in zip(xy, radii, strict=True)]
        width, height = high - low
        found.append(plate(width, height, DARK if bright else BRIGHT, spots).on_body(T))
    return tuple(found)


def _alike(a: DiscTarget, b: DiscTarget) -> bool:
    """Return whether two bodies of discs are painted alike: to a micrometre, and 1e-6 of the normals."""
    pairs = ((a.body.points, b.body.points), (a.radii_m, b.radii_m), (a.normals, b.normals), (a.bright, b.bright))
    return all(x.shape == y.shape and np.allclose(x, y, rtol=0, atol=1e-6) for x, y in pairs)


def body_target(scale: float = 1.0, depth: float = 1.0) -> Composite:
    """Return what :func:`body_text` describes: so many times as large, its wings so many times as far behind the plate."""
    spots = [(face, spot) for face in _FACES for spot in face.discs]
    points = np.array([transform(face.T_body_face, np.array([x, y, 0.0])) for face, (_, x, y, _) in spots])
    body = Body(NAME, tuple(name for _, (name, *_) in spots), scale * points * (1.0, 1.0, depth))
    radii = scale * np.array([radius for _, (*_, radius) in spots])
    normals = np.array([-face.T_body_face[:3, 2] for face, _ in spots])
    return Composite(NAME, (), DiscTarget(body, radii, np.ones(len(spots), dtype=bool), normals))


def body_text(scale: float = 1.0, depth: float = 1.0) -> str:
    """Return the body's file (docs/howto/targets.md)."""
    discs = body_target(scale, depth).discs
    assert discs is not None
    lines = ["version = 2", f'name = "{NAME}"']
    for name, p, normal, radius in zip(
        discs.body.point_names, discs.body.points, discs.normals, discs.radii_m, strict=True
    ):
        at, out = (", ".join(f"{n:.9f}" for n in values) for values in (1e3 * p, normal))
        lines += ["", "[[markers]]", f'name = "{name}"', f"position_mm = [{at}]", f"normal = [{out}]"]
        lines.append(f"disc = {{ radius_mm = {1e3 * radius:g}, bright = true }}")
    return "\n".join(lines) + "\n"
