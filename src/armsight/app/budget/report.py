"""What ``armsight budget`` says: a plan in, a Report out. Lengths in mm, angles in degrees; JSON in m and rad."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from armsight.app.budget.plan import RigPlan, catalogue, planned
from armsight.app.show.messages import Note
from armsight.app.show.page import PAGE
from armsight.app.show.plotting import new_figure
from armsight.app.show.report import Fact, Grade, Plot, Report, Section, figure_files
from armsight.app.show.table import TextTable
from armsight.data import Array
from armsight.errors import InputError
from armsight.vision.calibrate.budget import CAUSES, Budget

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: A change that gains less than this share is not worth a line; half: lines that nobody buys, double: cheap gains lack.
WORTH = 0.1
#: What would make it better -> class of its price, 0 for nothing, and what of a plan it changes.
_CHANGES: dict[str, tuple[int, Callable[[RigPlan], dict[str, object]]]] = {
    "start both cameras by one trigger": (2, lambda plan: {"skew_ms": 0.0, "start_ms": 0.05}),
    "measure at rest": (0, lambda plan: {"speed": "0m/s"}),
    "twice as many pairs of the board": (0, lambda plan: {"pairs": 2 * plan.pairs}),
    "cameras half as far apart again": (0, lambda plan: {"baseline": f"{1.5e3 * plan.baseline_m:g}mm"}),
    "a body half as large again": (1, lambda plan: {} if plan.body else {"body_scale": 1.5 * plan.body_scale}),
    "half the exposure, twice the light": (1, lambda plan: {"exposure_ms": 0.5e3 * plan.timing["exposure"]}),
    "a board printed on a stiff plate, its size measured": (
        1,
        lambda plan: {"board_print": 1e-4, "board_bent": "0.03mm"},
    ),
    "the body's markers measured after printing": (
        0,
        lambda plan: {"body_print": "0.01mm", "body_bent": "0.02mm", "body_size": 1e-4},
    ),
    "calibrate again when the room is 1 K warmer": (0, lambda plan: {"warming_k": 1.0}),
}
#: Causes that have no model, each with its reason.
_UNKNOWN = (
    "the detector's failures (glints, hidden markers): the workcell has them, the budget does not",
    "smear by a camera that mixes images of a moving scene",
    "focus that breathes: an autofocus must be switched off",
    "poses of the board other than all over the images",
    "a mount that bends, not only grows, as it warms",
)


#: Names of all files that a report has.
REPORT_FILES = (PAGE, "budget.json", *figure_files("budget", ("volume",)))


def budget_report(plan: RigPlan) -> Report:
    """Return what a plan's budget says."""
    found = planned(plan)
    loop = bool(plan.arm)
    moving, rest = found.cov(), found.cov(moving=False)
    figures = {name: _figures(found, cov) for name, cov in {"moving": moving, "at_rest": rest}.items()}
    if loop:
        figures["closed_loop_at_rest"] = _figures(found, found.cov(moving=False, loop=True))
    changes = _changes(plan, figures["moving"]["level_m"])
    rows, causes = _causes(found)
    shares = {name: found.rms(found.cov(of=name))[0] for name in ("precision", "trueness")}
    lateral, depth = found.along(moving)
    values = {
        "plan": {each.name: getattr(plan, each.name) for each in plan.settings()},
        "focal_px": plan.focal_px,
        "results": figures,
        "precision_rms_m": shares["precision"],
        "trueness_rms_m": shares["trueness"],
        "lateral_rms_m": lateral,
        "depth_rms_m": depth,
        "causes": causes,
        "changes": [{"change": text, "price": price, "level_m": m} for text, price, m in changes],
        "not_modelled": _UNKNOWN,
    }
    more = TextTable(
        "what changes it most for least money, in motion",
        ("change", "price class", "95 % within"),
        tuple((text, str(price), f"{1e3 * m:.2g} mm") for text, price, m in changes),
    )
    said = (
        f"precision {1e3 * shares['precision']:.2g} mm, trueness {1e3 * shares['trueness']:.2g} mm; one lateral axis "
        f"{1e3 * lateral:.2g} mm, depth {1e3 * depth:.2g} mm (RMS over the volume, in motion)"
    )
    table = TextTable("causes, RMS over the volume", ("cause", "mm", "deg", "share", "halved: 95 % within"), rows)
    positions = Plot("volume", partial(_map, found), "", "Error at 95 % in the middle of the volume")
    sections: dict[str, Section] = {
        "result": ("Result", [Fact(said), table, more]),
        "map": ("Over the volume", [replace(positions, caption="95 % of the errors in motion are within, mm.")]),
    }
    notes = [Note("note", f"chosen: {_chosen(plan)}"), *(Note("note", f"not in the budget: {why}") for why in _UNKNOWN)]
    headline = f"{plan.cameras.text}; {plan.baseline} apart, volume {plan.volume} at {plan.distance}"
    answer = _answer(plan, found, figures, causes)
    return Report("budget", "Before you buy", plan.volume, headline, sections, notes, values, "budget", answer)


def _figures(found: Budget, cov: Array) -> dict[str, float]:
    """Return the RMS over the volume, and what 95 % of the errors are within at its worst position; m, rad."""
    (m, rad), (far, rotated) = found.rms(cov), found.at_level(cov)
    return {"rms_m": m, "rms_rad": rad, "level_m": float(far.max()), "level_rad": float(rotated.max())}


def _causes(found: Budget) -> tuple[tuple[tuple[str, ...], ...], list[dict[str, object]]]:
    """Return the rows of the table of causes, the costliest first, and the same for programs."""
    total = np.trace(found.cov()[:, :3, :3], axis1=1, axis2=2).mean()
    rows, listed = [], []
    for name in found.factors:
        own = found.cov(of=name, loop=True)
        m, rad = found.rms(own)
        share = 0.0 if CAUSES[name].loop else m**2 / total
        halved = float(found.at_level(found.cov(scaled=name, by=0.5))[0].max())
        kind = CAUSES[name]
        listed.append(
            {
                "cause": name,
                "rms_m": m,
                "rms_rad": rad,
                "share": share,
                "halved_level_m": halved,
                "moving": kind.moving,
                "common": kind.common,
                "loop": kind.loop,
            }
        )
        shown = ("loop", "") if kind.loop else (f"{100 * share:.0f} %", f"{1e3 * halved:.2g} mm")
        rows.append((share, m, (name, f"{1e3 * m:.2g}", f"{math.degrees(rad):.2g}", *shown)))
    order = sorted(range(len(rows)), key=lambda k: (-rows[k][0], -rows[k][1]))
    return tuple(rows[k][2] for k in order), [listed[k] for k in order]


def _answer(
    plan: RigPlan, found: Budget, figures: dict[str, dict[str, float]], causes: list[dict[str, object]]
) -> tuple[Grade, str]:
    """Return the answer in two sentences, and its colour."""
    move, rest, requested = figures["moving"], figures["at_rest"], plan.requested
    said = f"95 % within {1e3 * move['level_m']:.2g} mm in motion, {1e3 * rest['level_m']:.2g} mm at rest"
    said += f", {math.degrees(move['level_rad']):.2g} and {math.degrees(rest['level_rad']):.2g} deg"
    if "closed_loop_at_rest" in figures:
        said += f"; the loop brings the arm to {1e3 * figures['closed_loop_at_rest']['level_m']:.2g} mm at rest"
    first = causes[0]
    worst = float(found.at_level(found.cov(of=str(first["cause"])))[0].max())
    costs = f" {str(first['cause']).capitalize()} costs {1e3 * worst:.2g} mm"
    if requested is None:
        return "fair", f"{said}.{costs}."
    asked = f"{1e3 * requested[0]:g} mm" + (f", {math.degrees(requested[1]):g} deg" if requested[1] else "")

    def reached(of: dict[str, float]) -> bool:
        return of["level_m"] <= requested[0] and (not requested[1] or of["level_rad"] <= requested[1])

    grade: Grade = "good" if reached(move) else "fair" if reached(rest) else "poor"
    body = float(found.at_level(found.cov(of="print of the body"))[0].max())
    floor = (
        "" if body <= requested[0] else f" The print of the body alone costs {1e3 * body:.2g} mm: no camera reaches it."
    )
    return grade, f"{said}; requested {asked}.{costs}.{floor}"


def _changes(plan: RigPlan, now_m: float) -> list[tuple[str, int, float]]:
    """Return the changes that are worth it: what, class of its price, m; the best of a price first."""
    found = []
    for text, (price, change) in _CHANGES.items():
        focal_widths = plan.focal_px / plan.cameras.image_size_px[0]  # the lens stays
        try:
            after = planned(replace(plan, focal_widths=focal_widths, **change(plan)))  # type: ignore[arg-type]
        except InputError:  # such a rig cannot be built
            continue
        m = float(after.at_level(after.cov())[0].max())
        if m < (1 - WORTH) * now_m:
            found.append((text, price, m))
    for name, each in catalogue().items():
        if each.price > plan.cameras.price:
            try:
                after = planned(
                    replace(plan, camera=name, focal_widths=0.0, skew_ms=-1.0, start_ms=-1.0, exposure_ms=-1.0)
                )
            except InputError:
                continue
            m = float(after.at_level(after.cov())[0].max())
            if m < (1 - WORTH) * now_m:
                found.append((f"{name}: {each.text}", each.price, m))
    return sorted(found, key=lambda one: (one[1], one[2]))


def _chosen(plan: RigPlan) -> str:
    """Say what was left out."""
    left = [each.name for each in plan.settings() if each.name not in plan.named]
    shown = {
        "focal_widths": f"{plan.focal_px / plan.cameras.image_size_px[0]:.2f}",
        "verging_deg": f"{plan.rig.convergence_deg:.0f}",
    }
    timed = {"skew_ms": "skew", "start_ms": "start", "exposure_ms": "exposure"}
    shown |= {key: f"{1e3 * plan.timing[name]:.2g}" for key, name in timed.items()} | {
        "rate_hz": f"{plan.timing['rate']:g}"
    }
    shown |= {"body": "tool_body", "want": "none", "arm": "none"}
    return ", ".join(f"{name} {shown.get(name, getattr(plan, name))}" for name in left)


def _map(found: Budget) -> Figure:
    """Draw the error at 95 % over the volume, seen from above: near below, the worst height of each column."""
    figure = new_figure(3.2)
    ax = figure.subplots()
    level = 1e3 * found.at_level(found.cov())[0]
    across, deep = 1e3 * found.p_left[:, 0], 1e3 * (found.p_left @ found.forward)
    order = np.argsort(level)
    shown = ax.scatter(across[order], deep[order], c=level[order], s=420, marker="s", cmap="viridis")
    for k in order:
        ax.annotate(f"{level[k]:.2f}", (across[k], deep[k]), ha="center", va="center", fontsize=7, color="white")
    figure.colorbar(shown, ax=ax, label="mm")
    ax.set(xlabel="across, mm", ylabel="depth, mm")
    ax.margins(0.2)
    return figure
