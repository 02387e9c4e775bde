"""An arm in one picture: at home, in space and from two sides, with the frames of its links."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armsight.app.show.plotting import BLUE, INK, MUTED, ORANGE, RED, drawing, new_figure, png
from armsight.data import Array
from armsight.files import replacing
from armsight.robot.kinematics.arm import Arm

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Colours of the x, y and z axes of a frame.
AXES = (RED, "#2f855a", BLUE)
#: Length of a frame's axes, as a share of the drawing.
SHARE = 0.11
#: Name -> columns of the base frame across and up, of the views from two sides.
VIEWS = {"from the side": (0, 2), "from above": (0, 1)}


def write_arm_figure(arm: Arm, path: Path) -> None:
    """Plot an arm at home and write it as a PNG.

    Raises:
        InputError: matplotlib is missing, or the file cannot be written.
    """
    with drawing():
        data = png(_figure(arm))
    with replacing(path, "wb") as file:
        file.write(data)


def skeleton(arm: Arm, q: Array) -> tuple[Array, Array]:
    """Return the arm as a line through its joints and links (K, 3), m, and its frames (n + 2, 4, 4), at angles (n,)."""
    Ts = arm.links(q)
    points = [np.zeros(3), Ts[0, :3, 3]]
    for i in range(arm.joints):
        before, after = Ts[i], Ts[i + 1]
        if arm.convention == "standard":  # along the joint's axis, then along the link
            points.append(before[:3, 3] + arm.d[i] * before[:3, 2])
        else:
            points.append(after[:3, 3] - arm.d[i] * after[:3, 2])
        points.append(after[:3, 3])
    points.append(Ts[-1, :3, 3])
    return np.array(points), Ts


def _figure(arm: Arm) -> Figure:
    """Space on the left, the views on the right."""
    points, Ts = skeleton(arm, arm.home)
    points, origins = 1e3 * points, 1e3 * Ts[:, :3, 3]
    low, high = points.min(axis=0), points.max(axis=0)
    size = SHARE * float((high - low).max())
    figure = new_figure(5.6)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1.0))
    space: Any = figure.add_subplot(grid[:, 0], projection="3d")
    space.plot(*points.T, color=INK, lw=3.5, solid_capstyle="round", solid_joinstyle="round")
    space.scatter(*origins[:-1].T, color=ORANGE, s=26, depthshade=False, zorder=5)
    for T, origin in zip(Ts, origins, strict=True):
        for axis, colour in enumerate(AXES):
            space.plot(*np.array([origin, origin + size * T[:3, axis]]).T, color=colour, lw=1.6)
    for name, origin in _names(origins, size):
        space.text(*(origin + 0.35 * size), name, fontsize=7.5, color=INK)
    space.set_box_aspect(np.maximum(high - low, 0.3 * float((high - low).max())) + 2 * size)
    for axis, letter in enumerate("xyz"):
        middle, half = (low[axis] + high[axis]) / 2, max(high[axis] - low[axis], 0.3 * float((high - low).max())) / 2
        getattr(space, f"set_{letter}lim")(middle - half - size, middle + half + size)
        getattr(space, f"set_{letter}label")(f"{letter}, mm")
        space.locator_params(axis=letter, nbins=3 if letter == "y" else 6)
    space.view_init(elev=22, azim=-60)
    degrees = ", ".join(f"{angle:g}" for angle in np.round(np.degrees(arm.home), 3) + 0.0)
    space.set_title(f"{arm.name} at home ({degrees} deg); frames: x red, y green, z blue")
    for row, (title, (across, up)) in enumerate(VIEWS.items()):
        _view(figure.add_subplot(grid[row, 1]), title, across, up, points, Ts, size)
    return figure


def _view(axes: Any, title: str, across: int, up: int, points: Array, Ts: Array, size: float) -> None:  # noqa: ANN401
    """Plot the arm as seen along one axis of the base."""
    axes.plot(points[:, across], points[:, up], color=INK, lw=3, solid_capstyle="round", solid_joinstyle="round")
    for T in Ts:
        for axis, colour in enumerate(AXES):
            line = np.array([1e3 * T[:3, 3], 1e3 * T[:3, 3] + size * T[:3, axis]])
            axes.plot(line[:, across], line[:, up], color=colour, lw=1.3)
    axes.plot(1e3 * Ts[:-1, across, 3], 1e3 * Ts[:-1, up, 3], "o", color=ORANGE, ms=4)
    axes.axhline(0, color=MUTED, lw=0.5, zorder=0)
    axes.axvline(0, color=MUTED, lw=0.5, zorder=0)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{'xyz'[across]}, mm")
    axes.set_ylabel(f"{'xyz'[up]}, mm")
    axes.set_title(title)


def _names(origins: Array, size: float) -> list[tuple[str, Array]]:
    """Return a label and a position (3,), mm, for each group of frames at about one position."""
    labels: list[tuple[list[str], Array]] = []
    for name, origin in zip(["0", *(str(i) for i in range(1, len(origins) - 1)), "tool"], origins, strict=True):
        for names, position in labels:
            if np.linalg.norm(position - origin) < 0.3 * size:
                names.append(name)
                break
        else:
            labels.append(([name], origin))
    return [(" ".join(names), position) for names, position in labels]
