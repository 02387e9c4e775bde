"""Words for what is said of a body: swaps of discs, distances, axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armsight.data import Array, Body
from armsight.vision.markers.body_layout import Layout
from armsight.vision.discs.symmetry import Relabeling

#: Within this angle a direction is called by the name of an axis, cosine.
_ALONG = float(np.cos(np.radians(8.0)))


def swap_words(relabeling: Relabeling, names: Sequence[str]) -> str:
    """Say which discs are taken for which: "P1 and P2 exchanged", "P1 P2 P3 taken for P2 P3 P1"."""
    pairs = [(i, j) for i, j in zip(relabeling.seen.tolist(), relabeling.taken_for.tolist(), strict=True) if i != j]
    if len(pairs) == 2 and pairs[0] == pairs[1][::-1]:
        return f"{names[pairs[0][0]]} and {names[pairs[0][1]]} exchanged"
    shown, more = pairs[:6], " ..." if len(pairs) > 6 else ""
    return f"{' '.join(names[i] for i, _ in shown)}{more} taken for {' '.join(names[j] for _, j in shown)}{more}"


def pair_words(relabeling: Relabeling, body: Body) -> str:
    """Say which distance tells a swap best: "P1-P3 is 63.20 mm and P2-P3 63.60 mm, 0.40 mm apart"."""
    p = body.points
    seen, taken = relabeling.seen, relabeling.taken_for
    own = np.linalg.norm(p[seen][:, None] - p[seen][None], axis=2)
    other = np.linalg.norm(p[taken][:, None] - p[taken][None], axis=2)
    a, b = np.unravel_index(int(np.abs(own - other).argmax()), own.shape)
    first = f"{body.point_names[seen[a]]}-{body.point_names[seen[b]]}"
    second = f"{body.point_names[taken[a]]}-{body.point_names[taken[b]]}"
    return (
        f"{first} is {1e3 * own[a, b]:.2f} mm and {second} {1e3 * other[a, b]:.2f} mm, "
        f"{1e3 * abs(own[a, b] - other[a, b]):.2f} mm apart"
    )


def axis_words(axis: Array, forward: Array, layout: Layout) -> str:
    """Name a direction (3,) of the body: one of its axes, the line of two markers, or numbers."""
    words = []
    for name, unit in zip("xyz", np.eye(3), strict=True):
        if abs(axis @ unit) > _ALONG:
            words.append(f"the body's {name} axis")
    if not words and layout.discs is not None:
        p, names = layout.discs.body.points, layout.discs.body.point_names
        i, j = np.triu_indices(len(p), 1)
        along = np.abs((p[j] - p[i]) @ axis) / np.maximum(np.linalg.norm(p[j] - p[i], axis=1), 1e-12)
        if len(along) and along.max() > _ALONG:
            best = int(along.argmax())
            words.append(f"the line {names[i[best]]}-{names[j[best]]}")
    if not words:
        words.append(f"the body's direction ({', '.join(f'{c:.2f}' for c in axis + 0.0)})")
    if abs(axis @ forward) > _ALONG:
        words.append("the direction of sight")
    return words[0] + (f" ({words[1]})" if len(words) > 1 else "")
