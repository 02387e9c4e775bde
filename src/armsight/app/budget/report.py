"""What ``armsight budget`` says: a budget in, a Report out. Lengths in mm, angles in degrees; JSON in m and rad."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.show.messages import Note
from armsight.app.show.page import PAGE
from armsight.app.show.plotting import Figure, subplots
from armsight.app.show.report import Fact, Grade, Lines, Plot, Report, Section, figure_files
from armsight.app.show.table import TextTable
from armsight.sim.budget.plan import KEYS, PRICES, RigPlan, catalogue, planned
from armsight.sim.budget.result import AT_REST, NOT_MODELLED, RigBudget, with_pairs
from armsight.sim.workcell.body import body_text

_SHOWN = 0.01  # share of lost shots that is shown; half: one in 200 is, double: one in 50 is not
#: Names of all files that a report has.
REPORT_FILES = (PAGE, "budget.json", "rig.json", "body.toml", "body.pdf", *figure_files("budget", ("volume",)))


def budget_report(found: RigBudget, alternatives: Sequence[RigBudget] = (), run: Path | None = None) -> Report:
    """Return what a plan's budget says, the best one's beside its alternatives, that of a run beside what it measured."""
    plan, values = found.plan, found.to_dict()
    if alternatives:
        values["alternatives"] = [
            {"group": one.group, "price": one.plan.cameras.price, **_asked(one.plan), **one.moving._asdict()}
            for one in alternatives
        ]
    parts = [f"{name} {1e3 * values[f'{name}_rms_m']:.2g} mm" for name in ("precision", "trueness", "lateral", "depth")]
    shares = f"{', '.join(parts)} (RMS over the volume, in motion; lateral: one axis)"
    beside = []
    if run:
        from armsight.app.budget.run import against_run  # not above: a plan needs nothing of what reads runs

        table, values["run"] = against_run(run, plan)
        beside.append(table)
    states = found.states
    others = f"one camera at rest {states['one_camera']}; two {states['at_rest']}; "
    others += f"three, the mean of their pairs, {states['three_cameras']}"
    if found.at_rest.level_m > states["one_camera"].level_m:
        others += "; two take the distance from the size of the calibration's board, one from that of the body"
    rows = tuple(
        (each.cause, f"{1e3 * each.rms_m:.2g}", f"{math.degrees(each.rms_rad):.2g}")
        + (("loop", "") if each.loop else (f"{100 * each.share:.0f} %", f"{1e3 * each.halved_level_m:.2g} mm"))
        for each in found.causes
    )
    table = TextTable("causes, RMS over the volume", ("cause", "mm", "deg", "share", "halved: 95 % within"), rows)
    more = TextTable(
        f"what changes it most for least money, in motion (price class: {PRICES})",
        ("change", "price class", "95 % within", "lost"),
        tuple((text, str(price), f"{1e3 * m:.2g} mm", f"{100 * lost:.0f} %") for text, price, m, lost in found.changes),
    )
    caption, title = "95 % of the errors in motion are within, mm.", "Error at 95 % over the volume, seen from above"
    sections: dict[str, Section] = {
        "result": ("Result", [Fact(shares), Fact(others), table, more, *_compared(found, alternatives), *beside]),
        "map": ("Over the volume", [Plot("volume", partial(_map, found), caption, title)]),
        "missing": ("Limits", [Lines(NOT_MODELLED, "not in the budget:")]),
    }
    notes, cameras = [f"chosen: {_chosen(plan)}"], f"{plan.cameras.text}{_unlike(plan)}; {plan.baseline} apart"
    if plan.rig:
        cameras = f"{plan.rig}: {{}}x{{}} px, {1e3 * plan.baseline_m:.4g} mm apart".format(*plan.image_size_px)
        if not {"camera", "preset"} & {*plan.named}:
            text = f"noise and exposure of the rig's cameras are not known, those of {plan.camera} are taken: give --camera"
            notes.insert(0, text)
        if chosen := [f"{key} {getattr(plan, key)}" for key in ("volume", "distance") if key not in plan.named]:
            text = f"{', '.join(chosen)}: chosen, as the rig file does not say where it measures: give --volume, --distance"
            notes.insert(0, text)
    headline = f"{cameras}, volume {plan.volume} at {plan.distance}"
    said, title = [Note("note", text) for text in notes], "Before you buy"
    return Report("budget", title, plan.volume, headline, sections, said, values, "budget", _answer(found))


def to_build(found: RigBudget) -> dict[str, str]:
    """Return the files of what is to be built: the nominal rig, and the default body unless the plan has one of its own."""
    plan, source = found.plan, {"source": "armsight budget: planned, not calibrated"}
    if plan.rig:
        return {}
    rig = replace(plan.stereo_rig, cov=plan.conditions.cov_calibration, provenance=source)
    body = {} if plan.body else {"body.toml": body_text(plan.body_scale, plan.body_depth)}
    return {"rig.json": rig.to_text()} | body


def _asked(plan: RigPlan) -> dict[str, Any]:
    """Return what an optimised plan says, what follows from the rest as numbers."""
    return {key: getattr(plan, key) for key in ("camera", "baseline", "distance", "body_scale", "pairs")} | {
        "focal_widths": round(plan.focal_px / plan.image_size_px[0], 3),
        "focal_mm": round(plan.focal_mm, 1),
        "verging_deg": round(plan.stereo_rig.convergence_deg, 1),
        "body_depth": plan.body_depth,
        "exposure_ms": round(1e3 * plan.timing["exposure"], 3),
    }


def _compared(found: RigBudget, alternatives: Sequence[RigBudget]) -> list[TextTable | Fact]:
    """Return the tables of alternatives; those of one group differ by less than the prediction is off."""
    if not alternatives:
        return []
    title = "the best of each class, 95 % in motion; those of one group differ by less than predictions are off"
    reached = [
        (one.plan.camera, str(one.plan.cameras.price), chr(ord("A") + one.group), f"{one.mm:.2g}", f"{one.deg:.2g}",
         f"{100 * one.moving.lost_share:.0f} %") for one in alternatives
    ]  # fmt: skip
    build = [_asked(one.plan) for one in alternatives]
    with_more = [RigBudget(one, planned(one)) for one in with_pairs(replace(found.plan, pairs=RigPlan.pairs))]
    more = ", ".join(f"{each.plan.pairs} give {each.mm:.2g} mm" for each in with_more)
    return [
        TextTable(title, ("camera", "price class", "group", "mm", "deg", "lost"), tuple(reached)),
        TextTable("what to build for it", tuple(build[0]), tuple(tuple(map(str, each.values())) for each in build)),
        *(
            [Fact(f"pairs of the board: {more}; as few as differ by less than predictions are off")]
            * (len(with_more) > 1)
        ),
    ]


def _answer(found: RigBudget) -> tuple[Grade, str]:
    """Return the answer in two sentences, and its colour."""
    move, rest, requested = found.moving, found.at_rest, found.plan.requested
    mean = ", the mean over the volume" * (found.plan.objective == "mean")
    said = f"95 % within {move} at {found.plan.speed}; {rest} at rest{mean}"
    if move.lost_share > _SHOWN:
        lost = f"{100 * move.lost_share:.0f} % of the shots in motion are lost where most are"
        said += f"; {lost}: their two images differ by more than the search allows"
    if loop := found.states.get("closed_loop_at_rest"):
        said += f"; the loop brings the arm to {loop.mm:.2g} mm at rest"
    costs = f" {(first := found.causes[0].cause).capitalize()} costs {1e3 * found.level_m(of=first):.2g} mm"
    ways = [one for one in found.changes if one.change != AT_REST and one.change.split(":")[0] not in catalogue()]
    to_do = [min(ways, key=lambda one: one.level_m).change] if ways else []
    to_do += [f"measure slower than {found.slower_m_s:.2g} m/s"] if found.slower_m_s else []
    costs += f"; what helps most: {', or '.join(to_do)}" if to_do else ""
    if requested is None:
        return "fair", f"{said}.{costs}."
    asked = f"{1e3 * requested[0]:g} mm" + (f", {math.degrees(requested[1]):g} deg" if requested[1] else "")
    grade: Grade = "good" if found.reached(move) else "fair" if found.reached(rest) else "poor"
    reached = {"good": "reached", "fair": "reached at rest only", "poor": "not reached"}[grade]
    return grade, f"{asked} requested: {reached}. {said}.{costs}."


def _unlike(plan: RigPlan) -> str:
    """Say in what the cameras are other than their class."""
    keys = ("preset", "image", "f_number", "skew_ms", "start_ms", "readout_ms", "exposure_ms", "refocus_ppm")
    said = [f"{key} {getattr(plan, key)}" for key in keys if key in plan.named]
    if plan.preset:
        said += [
            f"{name}_ms {1e3 * plan.timing[name]:.2g}" for name in ("skew", "readout") if f"{name}_ms" not in plan.named
        ]
    if (own := plan.cameras.own_lens) and abs(now := plan.focal_px / plan.image_size_px[0] - own) > 1e-3:
        said += [f"a lens of {own + now:.2f} widths in place of {own:.2f}"]
    return f", but {', '.join(said)}" if said else ""


def _chosen(plan: RigPlan) -> str:
    """Say what was left out."""
    shown = {
        "focal_widths": f"{plan.focal_px / plan.image_size_px[0]:.2f} ({plan.focal_mm:.2g} mm)",
        "verging_deg": f"{plan.stereo_rig.convergence_deg:.0f}",
        "rate_hz": f"{plan.timing['rate']:g}",
        **{f"{name}_ms": f"{1e3 * plan.timing[name]:.2g}" for name in ("skew", "start", "readout", "exposure")},
        **{name: getattr(plan.cameras, name) for name in ("preset", "f_number", "refocus_ppm")},
        **{"body": "tool_body", "distances": ""},
    }
    said = ((key, shown.get(key, getattr(plan, key))) for key in KEYS if key not in (*plan.named, *plan.of_rig))
    return ", ".join(f"{key} {value}" for key, value in said if value != "")


def _map(of: RigBudget) -> Figure:
    """Draw the error at 95 % over the volume, seen from above: near below, of each column its worst or its mean height."""
    figure, ax = subplots(3.2)
    found, every = of.found, 1e3 * of.found.at_level(of.found.cov())[0]
    seen = np.round(1e4 * np.column_stack([found.p_left[:, 0], found.p_left @ found.forward]))
    columns, which = np.unique(seen, axis=0, return_inverse=True)
    level = np.array([of.plan.overall(every[which == k]) for k in range(len(columns))])
    across, deep = columns.T / 10
    shown = ax.scatter(across, deep, c=level, s=420, marker="s", cmap="viridis")
    for x, y, each in zip(across, deep, level, strict=True):
        dark = each < (level.min() + level.max()) / 2
        ax.annotate(f"{each:.2f}", (x, y), ha="center", va="center", fontsize=7, color="white" if dark else "black")
    figure.colorbar(shown, ax=ax, label="mm")
    ax.set(xlabel="across, mm", ylabel="depth, mm")
    ax.margins(0.2)
    return figure
