"""An arm in one picture: at home, in space and from two sides, with the frames of its links."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.show.plotting import BLUE, INK, MUTED, ORANGE, RED, Figure, drawing, new_figure, png
from armsight.data import Array
from armsight.files import replacing
from armsight.robot.kinematics.arm import Arm

#: Colours of the x, y and z axes of a frame, and their length as a share of the drawing.
AXES, SHARE = (RED, "#2f855a", BLUE), 0.11
#: Name -> columns of the base frame across and up, of the views from two sides.
VIEWS = {"from the side": (0, 2), "from above": (0, 1)}
#: Of the arm's line.
_ARM: dict[str, Any] = {"color": INK, "lw": 3.5, "solid_capstyle": "round", "solid_joinstyle": "round"}


def write_arm_figure(arm: Arm, path: Path) -> None:
    """Plot an arm at home and write it as a PNG."""
    with drawing():
        data = png(_figure(arm))
    with replacing(path, "wb") as file:
        file.write(data)


def _skeleton(arm: Arm) -> tuple[Array, Array]:
    """Return the arm at home as a line through its joints and links (K, 3), m, and its frames (n + 2, 4, 4)."""
    Ts = arm.links(arm.home)
    points = [np.zeros(3), Ts[0, :3, 3]]
    for before, after, d in zip(Ts[:-2], Ts[1:-1], arm.d, strict=True):
        along = before[:3, 3] + d * before[:3, 2]  # along the joint's axis, then along the link; modified: the reverse
        points += [along if arm.convention == "standard" else after[:3, 3] - d * after[:3, 2], after[:3, 3]]
    return np.array([*points, Ts[-1, :3, 3]]), Ts


def _figure(arm: Arm) -> Figure:
    points, Ts = _skeleton(arm)
    points, origins = 1e3 * points, 1e3 * Ts[:, :3, 3]
    low, high = points.min(axis=0), points.max(axis=0)
    extent = np.maximum(high - low, 0.3 * float((high - low).max()))
    size = SHARE * float((high - low).max())
    ends = origins[:, None] + size * Ts[:, :3, :3].transpose(0, 2, 1)  # of the axes of each frame
    figure = new_figure(5.6)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1.0))
    space: Any = figure.add_subplot(grid[:, 0], projection="3d")
    space.plot(*points.T, **_ARM)
    space.scatter(*origins[:-1].T, color=ORANGE, s=26, depthshade=False, zorder=5)
    for name, origin in _names(origins, size):
        space.text(*(origin + 0.35 * size), name, fontsize=7.5, color=INK)
    space.set_box_aspect(extent + 2 * size)
    for axis, letter in enumerate("xyz"):
        middle, half = (low[axis] + high[axis]) / 2, extent[axis] / 2
        getattr(space, f"set_{letter}lim")(middle - half - size, middle + half + size)
        getattr(space, f"set_{letter}label")(f"{letter}, mm")
        space.locator_params(axis=letter, nbins=3 if letter == "y" else 6)
    space.view_init(elev=22, azim=-60)
    degrees = ", ".join(f"{angle:g}" for angle in np.round(np.degrees(arm.home), 3) + 0.0)
    space.set_title(f"{arm.name} at home ({degrees} deg); frames: x red, y green, z blue")
    views = [(space, [0, 1, 2], 1.6)]
    for row, (title, (across, up)) in enumerate(VIEWS.items()):
        view: Any = figure.add_subplot(grid[row, 1])
        view.plot(points[:, across], points[:, up], **{**_ARM, "lw": 3})
        view.plot(origins[:-1, across], origins[:-1, up], "o", color=ORANGE, ms=4)
        view.axhline(0, color=MUTED, lw=0.5, zorder=0)
        view.axvline(0, color=MUTED, lw=0.5, zorder=0)
        view.set_aspect("equal", adjustable="datalim")
        view.set(xlabel=f"{'xyz'[across]}, mm", ylabel=f"{'xyz'[up]}, mm", title=title)
        views.append((view, [across, up], 1.3))
    for axes, seen, width in views:
        for origin, of_frame in zip(origins, ends, strict=True):
            for end, colour in zip(of_frame, AXES, strict=True):
                axes.plot(*np.array([origin, end])[:, seen].T, color=colour, lw=width)
    return figure


def _names(origins: Array, size: float) -> list[tuple[str, Array]]:
    """Return a label and a position (3,), mm, for each group of frames at about one position."""
    labels: list[tuple[list[str], Array]] = []
    for name, origin in zip(["0", *(str(i) for i in range(1, len(origins) - 1)), "tool"], origins, strict=True):
        near = next((names for names, at in labels if np.linalg.norm(at - origin) < 0.3 * size), None)
        labels.append(([name], origin)) if near is None else near.append(name)
    return [(" ".join(names), position) for names, position in labels]
