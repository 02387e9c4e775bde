"""What ``armsight identify`` prints: the held-out line first, then what was found, in mm and degrees."""

from __future__ import annotations

import numpy as np

from armsight.app.identify.run import Run
from armsight.loop.identify.identify import contributions
from armsight.loop.identify.model import Parameter
from armsight.loop.identify.backlash import Play, plays


def headline(run: Run) -> str:
    """Return the held-out line: before and after."""
    before, after = run.held_out.nominal.summary(), run.held_out.identified.summary()
    told = f"held-out error {1e3 * before['mean_m']:.3f} -> {1e3 * after['mean_m']:.3f} mm mean"
    told += f", {1e3 * before['max_m']:.2f} -> {1e3 * after['max_m']:.2f} mm largest"
    if "mean_rad" in after:
        told += f", {np.degrees(before['mean_rad']):.3f} -> {np.degrees(after['mean_rad']):.3f} deg mean"
    return f"{told} ({run.how})"


def value_text(p: Parameter, value: float) -> str:
    """Return a value in a person's unit."""
    if p.unit == "m":
        return f"{1e3 * value:.3f} mm"
    if p.unit == "rad":
        return f"{np.degrees(value):.4f} deg"
    if p.unit == "rad/m":
        return f"{np.degrees(value):.4f} deg/m"
    return f"{100 * value:.4f} %"


def text(run: Run, *, everything: bool = False) -> str:
    """Return what is printed after the headline; with ``everything`` also why the rest was not fitted."""
    found = run.found
    noise = f"noise {1e3 * found.solution.noise[0]:.3f} mm"
    if found.model.full:
        noise += f", {np.degrees(found.solution.noise[1]):.4f} deg"
    lines = [
        f"{len(run.measured)} poses, {int(found.solution.free.sum())} parameters fitted, {noise}; held-out residual over "
        f"its predicted sigma {run.held_out.residual_over_predicted:.2f}",
        "",
        "what each cause moves the tool by, RMS, beyond what those before it take up:",
    ]
    parts = contributions(found, run.measured).items()
    lines += [f"  {cause:<28} {1e3 * size:8.3f} mm" for cause, size in parts]
    lines += ["", f"  {'parameter':<12} {'nominal':>16} {'identified':>16} {'sigma':>14}"]
    nominal = found.model.nominal()
    for k, p in enumerate(found.model.parameters):
        if found.solution.free[k] and p.kind not in ("base", "tool", *([] if everything else ["ripple"])):
            value, sigma = found.value(p.name)
            row = (value_text(p, nominal[k]), value_text(p, value), value_text(p, sigma))
            tied = "  with others (-v)" if p.name in found.reasons and not everything else ""
            lines.append(f"  {p.name:<12} {row[0]:>16} {row[1]:>16} {row[2]:>14}{tied}")
    lines += [] if everything else _ripples(run)
    lines += ["", "play of each joint, stop to stop:"]
    lines += [f"  joint {p.joint + 1}  {_play_text(p)}" for p in plays(found, run.measured)]
    left = sum(
        not free and p.kind not in ("base", "tool")
        for p, free in zip(found.model.parameters, found.solution.free, strict=True)
    )
    lines += _not_fitted(run) if everything else ["", f"{left} more parameters were not fitted; -v says why"]
    pairs = found.correlated()
    if pairs:
        lines += ["", "correlations over 0.9 (more varied poses tell them apart):"]
        lines += [f"  {a} and {b}: {c:+.3f}" for a, b, c in pairs]
    return "\n".join(lines)


def _ripples(run: Run) -> list[str]:
    """Return how large the fast part of each sensor's curve is: its many numbers say nothing one by one."""
    found, lines = run.found, []
    for i in range(6):
        rows = [k for k, p in enumerate(found.model.parameters) if p.kind == "ripple" and p.joint == i]
        rows = [k for k in rows if found.solution.free[k]]
        if rows:
            size = np.degrees(np.sqrt(np.sum(found.solution.x[rows] ** 2) / 2))
            lines.append(
                f"  ripple{i + 1}_.. {len(rows)} numbers, together {size:.4f} deg RMS over a turn (-v lists them)"
            )
    return lines


def _play_text(play: Play) -> str:
    """Return a joint's play, and what showed it."""
    if not np.isfinite(play.value_rad):
        return play.how
    return f"{np.degrees(play.value_rad):.3f} +- {np.degrees(play.sigma_rad):.3f} deg, by {play.how}"


def _not_fitted(run: Run) -> list[str]:
    """Return the reasons of what was not fitted, equal ones together."""
    by_reason: dict[str, list[str]] = {}
    for p in run.found.model.parameters:
        reason = run.found.reasons.get(p.name)
        if reason is not None and p.kind not in ("base", "tool"):
            short = reason.split(":")[0] if reason.startswith("does not pay") else reason
            by_reason.setdefault(short, []).append(p.name)
    if not by_reason:
        return []
    return ["", "not fitted, or not alone:"] + [
        f"  {', '.join(names)}: {reason}" for reason, names in by_reason.items()
    ]
