"""The figures of a test in words, mm."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

#: Name, short name and what it is, of every figure.
MEANINGS = {
    "AP": "pose accuracy: from the command to the middle of the attained places",
    "RP": "pose repeatability: mean distance from that middle, plus three standard deviations",
    "vAP": "accuracy from several directions: largest distance between their middles",
    "AD": "distance accuracy: error of the mean distance between two poses",
    "RD": "distance repeatability: three standard deviations of it",
    "dAP": "drift: how far the middle wanders over five parts of the time",
    "mean error": "mean distance from the command over all poses",
    "largest error": "the largest of them",
    "AT": "path accuracy: largest distance of the mean path from the commanded one",
    "RT": "path repeatability: the largest along it",
    "circularity": "largest less smallest radius",
    "hysteresis": "largest difference of the radii of both ways",
    "play": "how much the radius jumps where the motion along that direction turns back",
    "jump": "the same where a joint turns back: what its backlash does to the radius there",
}


def figures(facts: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, float | None]]]:
    """Give short name, of what, and figure, of all figures of a test."""
    for name, p in facts.get("poses", {}).items():
        what = f"{name}, {p['count']} times"
        yield "AP", what, p["AP_m"]
        yield "RP", what, p["RP_m"]
        if name in facts.get("vAP_m", {}):
            yield "vAP", name, facts["vAP_m"][name]
    if "anywhere" in facts:
        a = facts["anywhere"]
        yield "mean error", f"{a['count']} poses", a["mean_m"]
        yield "largest error", f"{a['count']} poses", a["max_m"]
    if "distance" in facts:
        d = facts["distance"]
        what = f"{d['from']} to {d['to']}, {1e3 * d['commanded_m']:.1f} mm"
        yield "AD", what, d["AD_m"]
        yield "RD", what, d["RD_m"]
    if "drift" in facts:
        yield "dAP", f"{facts['drift']['pose']}, {np.ptp(facts['drift']['t_s']):.0f} s", facts["drift"]["max_m"]
    for name, p in facts.get("paths", {}).items():
        yield "AT", f"{name}, {p['count']} times", p["AT_m"]
        yield "RT", f"{name}, {p['count']} times", p["RT_m"]
    if "circle" in facts:
        c = facts["circle"]
        what = f"radius {1e3 * c['radius_m']:.1f} mm"
        yield "circularity", what, c["circularity_m"]
        yield "hysteresis", what, c["hysteresis_m"]
        for axis, play in zip(c["axes"], c["backlash_m"], strict=True):
            yield "play", f"along {direction(axis)}", play
        for turn in c["turns"]:
            way = "counter-clockwise" if turn["way"] > 0 else "clockwise"
            joints = ", ".join(map(str, turn["joints"]))
            yield (
                "jump",
                f"{'joints' if len(turn['joints']) > 1 else 'joint'} {joints} at {turn['angle_deg']:.0f} deg, {way}",
                turn["jump_m"],
            )


def direction(axis: list[float]) -> str:
    """Return a direction in words: x, or the numbers where it is along no axis of the base."""
    near = int(np.argmax(np.abs(axis)))
    return "xyz"[near] if axis[near] > 1 - 1e-6 else "({:.2f}, {:.2f}, {:.2f})".format(*(np.round(axis, 2) + 0.0))


def said(figure: Mapping[str, float | None]) -> str:
    """Return what a figure is, in words."""
    raw, clean, low, high, least = (1e3 * (figure[k] or 0.0) for k in ("raw", "clean", "low", "high", "resolvable"))
    if figure["low"] is None:
        return f"{raw:.3f} mm as measured; no interval without the instrument's sigma"
    if figure["clean"] is None:
        below = f"below {high:.3f} mm" if low >= 0 else f"{low:.3f} to {high:.3f} mm"
        return f"not resolvable: {below}; {least:.3f} mm could have been told ({raw:.3f} as measured)"
    return f"{clean:.3f} mm, {low:.3f} to {high:.3f} ({raw:.3f} as measured)"


def text(facts: Mapping[str, Any]) -> str:
    """Return all figures in words."""
    rows = list(figures(facts))
    wide = max(len(what) for _, what, _ in rows)
    lines = [f"{name:14s} {what:{wide}s}  {said(figure)}" for name, what, figure in rows]
    return "\n".join(
        ["figure without the instrument's noise, the interval that holds it to 95 %, as measured:", *lines]
    )
