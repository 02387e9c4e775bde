"""The report of a run: what summary.json holds, what the terminal says, and the page with its figures; made once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from armsight.app.run import figures, metrics
from armsight.app.run.experiment import RunResult
from armsight.app.run.metrics import PassErrors, Study, TrackMetrics
from armsight.app.run.tracks import Part, Tracks
from armsight.app.show.messages import UNTRUSTED, Level, Note, note, warn
from armsight.app.show.page import PAGE
from armsight.app.show.report import Block, Fact, Grade, Lines, Plot, Report, Section, Text
from armsight.app.show.table import TextTable
from armsight.data import Image
from armsight.errors import InputError
from armsight.loop.health import health_lines, unseen_lines
from armsight.loop.health.follow import correction_lines
from armsight.loop.identify.odometry import Odometry, odometry
from armsight.loop.running.beside import Fused
from armsight.loop.running.log import Log
from armsight.robot.kinematics.arm import Arm

#: Track -> its name in tables.
TRACKS = {
    "potentiometers": "joint readings by the nominal arm",
    "vision": "vision",
    "fused": "fused, smoothed",
    "live": "fused, live",
}
_DEG = float(np.degrees(1.0))
_POINTS = 4000  # of a line in a figure: more cannot be seen
#: Figure -> anchor and title of its section of the page, and its caption.
_FIGURES = {
    "pose": ("images", "Images", "The left camera's image with the measured pose."),
    "workcell": ("images", "Images", "The workcell from aside."),
    "joints": ("motion", "Joint angles and tool path", "Joint angles by their sensors, and reference; shaded: rests."),
    "path": ("motion", "", "The tool's path: from the joint sensors, from vision, from both fused, and the truth."),
    "errors": ("errors", "Errors against the truth", "Each track's error over time; the fused one's claimed 95% band."),
    "loop": ("loop", "Open loop and closed loop", "The same motions without and with vision in the loop."),
    "latency": (
        "latency",
        "Latency",
        "Time from a decoded image to its command while the body is followed, not searched.",
    ),
    "studies": (
        "studies",
        "What the error depends on",
        "Measured errors, their 95% intervals, and those predicted.",
    ),
    "overview": ("studies", "", ""),
}
VERSION = 2  # of a run's folder; 1 named the reference track and the reference angles differently
#: Basis of a command -> its text in run.log.
_BASED = {
    "planned": "as planned",
    "vision": "on vision",
    "bridged": "on the model while vision was missing",
    "potentiometers": "with the last correction, vision lost",
    "held": "with the correction held, as vision contradicted what was learned",
    "distrusted": "on the joint sensors, with what was learned before, as vision was wrong",
}


def report_of(
    result: RunResult,
    tracks: Tracks | None,
    studies: Sequence[Study] = (),
    picture: Image | None = None,
    workcell: Callable[[], Image] | None = None,
) -> Report:
    """Return the report of a run; ``tracks``: None where it ended before the hand-eye calibration.

    ``picture``: (H, W, 3) BGR, the left image with the measured pose; ``workcell``: returns one from aside.
    """
    led = None if result.led is None else result.led.to_json()
    values: dict[str, Any] = {"version": VERSION}
    tables, lines = list[TextTable | None](), list[str]()
    sections: Mapping[str, Section] = {}
    passes = None
    if tracks is not None:
        passes = _passes(result, tracks)
        before = None if result.open_s is None else tracks.between(*result.open_s)
        found = {} if before is None else metrics.against_truth(before, result.covered_s)
        values |= {name: _known(vars(each)) for name, each in found.items()}
        if before is not None and (occlusion := _occlusion(before, result.covered_s)) is not None:
            values["occlusion"] = occlusion
            most = f"{1e3 * occlusion['fused_position_max_m']:.2f} mm at most"
            lines.append(f"body hidden for {occlusion['duration_s']:g} s in motion: the estimate was off by {most}")
        if result.open_s is not None and (alone := _odometry(tracks.between(*result.open_s, most=_MOST), tracks.arm)):
            values["odometry"] = alone._asdict()
            lines.append(alone.line)
        if passes is not None:
            values["closed_loop"] = _passes_json(*passes)
        tables = [_track_table(found), _loop_table(passes)]
        lines += _measured(result, values, led, studies)
        sections = _figures(result, tracks, passes, studies, picture, workcell)
    elif led is not None:
        values["sync_led"] = led
    values |= {"health": [each.to_json() for each in result.health], "fixed_unseen": list(result.fixed_unseen)}
    values |= {"rig_corrections": [each.to_json() for each in result.log.corrections]}
    values |= {"rig_not_corrected": result.not_corrected, **result.properties, "ended_by": result.ended_text}
    notes = [] if tracks is None else notes_of(result)
    shown: list[Block] = list(filter(None, tables))
    sections = {
        "health": ("Do not trust this result", [Lines([each.line() for each in result.health], most=0)]),
        "result": ("Result", [*shown, Lines(notes, most=0), Fact(values=values), Text("\n".join(lines))]),
        **sections,
    }
    about, name = result.properties, result.setup.arm.name
    simulated = "simulated, {arm} · {cameras} · seed {seed}".format(**about) if "seed" in about else ""
    title, graded = f"A {'simulated ' if simulated else ''}run of the arm {name}, measured", assess(result, passes)
    return Report("run", title, simulated or name, "", sections, _said(result), prefix="", assessed=graded)


_MOST = 20_000  # rows of a run that show odometry; half: nothing, double: long runs take seconds


def _odometry(part: Part, arm: Arm) -> Odometry | None:
    attained = part.attained
    if len(attained) < 2:
        return None
    rows = (part.t_s >= attained.t_s[0]) & (part.t_s <= attained.t_s[-1])
    return odometry(arm, part.q[rows], attained.at(part.t_s[rows]))


_FEW = 0.8  # of the shots in view; half: misses are hardly noticed, 1: one missed shot is said


def assess(result: RunResult, passes: tuple[PassErrors, PassErrors] | None) -> tuple[Grade, str]:
    """Return the grade of a run, and in one sentence how good it is and what to do next; ``passes``: open and closed."""
    wrong = [each for each in result.health if each.forbids and each.corrected_s is None]
    if wrong:
        return "poor", f"Do not use this run: {wrong[0].line()}; mend that, and run it again."
    if result.ended_text is not None or result.handeye is None:
        why = result.ended_text or "no hand-eye calibration"
        return "poor", f"Ended early ({why}): what was measured until then is kept; run it again."
    counts = result.log.counts()
    share = counts["measured"] / max(counts["measured"] + counts["missed"] + counts["rejected"], 1)
    parts, gained = list[str](), True
    for what, key in (("follows its path", "path_m"), ("rests", "rest_m")):
        alone, closed = (None, None) if passes is None else (getattr(each, key) for each in passes)
        if alone is not None and closed is not None:
            gained = gained and closed < alone
            parts.append(f"{what} {1e3 * closed:.2f} mm off, without {1e3 * alone:.2f}")
    said = f"the hand-eye calibration is off by {1e3 * result.handeye.found.held_out.rms()[0]:.2f} mm"
    said = f"with the loop closed the tool {' and '.join(parts)}" if parts else said
    if result.health or share < _FEW:
        few = f"only {100 * share:.0f} % of the shots were measured: see run.log"
        why = result.health[0].line() if result.health else few
        return "fair", f"Usable with care: {said}; {why}."
    if not gained:
        return "fair", f"Usable, but the closed loop is not better in all: {said}; armsight check shows where."
    return "good", f"Good: {said}; armsight arm report shows what the arm's error is made of."


def _said(result: RunResult) -> list[Note]:
    level: Level = "error" if any(each.forbids for each in result.health) else "warn"
    remarks = [*unseen_lines(result.fixed_unseen), *correction_lines(result.log.corrections, result.not_corrected)]
    said = [Note(level, line) for line in health_lines(result.health)] + [Note("warn", line) for line in _lost(result)]
    return said + [Note("hint", line) for line in remarks]


def _lost(result: RunResult) -> list[str]:
    beside = result.setup.beside
    return [] if beside is None else [f"{beside.entry.reference.name}: {loss}" for loss in beside.losses]


def show(report: Report, folder: Path, *, as_json: bool) -> None:
    """Print a run's report, mm and degrees or JSON; end with UNTRUSTED where it must not be trusted."""
    report.echo(as_json=as_json)
    if not as_json:
        for each in report.notes:
            (note if each.level == "hint" else warn)(each.text)
        click.echo(f"{folder / PAGE} shows the run; {report.values['wall_s']:.0f} s")
    if report.noted("error"):
        click.get_current_context().exit(UNTRUSTED)


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if value is not None}


def _measured(result: RunResult, values: dict[str, Any], led: Any, studies: Sequence[Study]) -> list[str]:  # noqa: ANN401 - JSON
    """Add what the loop measured on its way to the values of a run; return what the terminal says of it."""
    log, lines = result.log, list[str]()
    assert result.handeye is not None
    if len(log.latency_s):
        t = metrics.spread(log.latency_s.array(1))
        values["latency_s"] = vars(t)
        shares = f"p50 {1e3 * t.p50:.2f} ms, p99 {1e3 * t.p99:.2f} ms, p99.9 {1e3 * t.p999:.2f} ms"
        lines.append(f"image to command: {shares}, longest {1e3 * t.max:.1f} ms while the body is followed")
    if len(log.search_s):
        t = metrics.spread(log.search_s.array(1))
        values["search_s"] = vars(t)
        lines.append(f"search of the body: median {1e3 * t.p50:.0f} ms, longest {1e3 * t.max:.0f} ms")
    if result.setup.beside is not None:
        values["reference"], line = _beside(result.setup.beside, log)
        lines.append(line)
    position, angle = result.handeye.found.held_out.rms()
    heldout = {"held_out_position_rms_m": position, "held_out_angle_rms_rad": angle}
    values["handeye"] = heldout | {"poses": len(result.handeye.q)}
    values["camera_delay_s"] = {"value": result.delay.delay_s, "sigma": result.delay.sigma_s}
    if result.shutters is not None:
        values["shutters"] = result.shutters.to_json()
    if led is not None:
        values["sync_led"] = led
    values["shots"] = log.counts() | {"misfit_max": log.misfit_max}
    kept = ("name", "unit", "values", "position_rms_m", "predicted_m")
    values["studies"] = [{key: getattr(study, key) for key in kept} for study in studies]
    return [*lines, f"{_shots_line(result)}; run.log has the reasons"]


def _beside(beside: Fused, log: Log) -> tuple[dict[str, Any] | None, str]:
    lives = log.lives.array(53)
    try:
        row = beside.row(lives[lives[:, 0] >= beside.begin_s, 17:].reshape(-1, 6, 6))
    except InputError as error:
        return None, str(error)
    return vars(row), row.line


def _shots_line(result: RunResult) -> str:
    line = "{measured} shots measured, {missed} missed, {rejected} rejected by the estimator"
    return line.format(**result.log.counts())


def _occlusion(before: Part, covered_s: tuple[float, float] | None) -> dict[str, float] | None:
    """Return the errors of the estimates while the body was hidden; None where it was not, or without a truth."""
    if before.truth is None or covered_s is None or not (before.t_s > covered_s[0]).any():
        return None
    found = {"duration_s": float(np.ptp(covered_s))}
    for name, track in (("fused", before.fused), ("live", before.live)):
        errors = metrics.track_metrics(track[metrics.hidden(track, covered_s)], before.truth)
        found |= {f"{name}_{key}": getattr(errors, key) for key in ("position_rms_m", "position_max_m")}
    return found


def _passes(result: RunResult, tracks: Tracks) -> tuple[PassErrors, PassErrors] | None:
    """Return the errors with potentiometers alone and with the loop closed; None where not both passes were made."""
    if result.open_s is None or result.closed_s is None:
        return None
    goals = {m.name: m.trajectory.at(m.trajectory.duration_s).q for m in result.plan.motions}
    singular = [name for name, q in goals.items() if metrics.partly_uncorrected(tracks.arm, q)]
    alone, closed = (metrics.pass_errors(tracks, span_s, singular) for span_s in (result.open_s, result.closed_s))
    return alone, closed


def _passes_json(before: PassErrors, after: PassErrors) -> dict[str, Any]:
    found: dict[str, Any] = {"singular_rests": {}}
    for when, each in (("before", before), ("after", after)):
        for name, value in each.singular.items():
            found["singular_rests"].setdefault(name, {})[f"rest_error_{when}_m"] = value
        most = max(each.rests.values(), default=None)
        values = {f"rest_error_{when}_m": each.rest_m, f"rest_error_{when}_max_m": most}
        found |= _known({**values, f"path_error_{when}_m": each.path_m})
    return found


def _track_table(found: Mapping[str, TrackMetrics]) -> TextTable | None:
    keys = [f"position_{kind}_m" for kind in ("rms", "max")] + ["rest_position_rms_m"]
    keys += [f"orientation_{kind}_rad" for kind in ("rms", "max")]
    keys += ["position_sigma_rms_m", "orientation_sigma_rms_rad", "inside_95_share"]
    columns = ("", "RMS, mm", "max, mm", "at rest, mm", "RMS, deg", "max, deg", "sigma, mm", "sigma, deg", "inside 95%")
    rows = [
        (shown, *(_cell(key, getattr(found[name], key)) for key in keys))
        for name, shown in TRACKS.items()
        if name in found
    ]
    title = "Error of the tool pose in motion, against the truth; sigma as claimed (RMS)"
    return TextTable(title, columns, tuple(rows)) if rows else None


def _cell(key: str, value: float | None) -> str:
    if value is None:
        return "–"
    if key.endswith("_share"):
        return f"{100 * value:.0f}%"
    return f"{(1e3 if key.endswith('_m') else _DEG) * value:.3f}"


def _loop_table(passes: tuple[PassErrors, PassErrors] | None) -> TextTable | None:
    if passes is None:
        return None
    rows = list[tuple[str, ...]]()
    for name, key in (("at rest, RMS", "rest_m"), ("from the path, RMS", "path_m")):
        alone, closed = (getattr(each, key) for each in passes)
        if alone is not None and closed is not None:
            rows.append((name, f"{1e3 * alone:.3f}", f"{1e3 * closed:.3f}", f"{alone / closed:.1f}"))
    columns = ("", "open loop, mm", "loop closed, mm", "times smaller")
    return TextTable("Distance of the tool from its command", columns, tuple(rows))


def notes_of(result: RunResult) -> list[str]:
    """Return lines on what was used, and what was left out and why."""
    log, handeye, delay = result.log, result.handeye, result.delay
    assert handeye is not None
    position, angle = handeye.found.held_out.rms()
    moved = "detections were moved to one time by the motion of the arm"
    modes = Counter({_BASED.get(mode, f"on {mode}"): count for mode, count in log.modes.items()})
    return [
        *health_lines(result.health),
        *_lost(result),
        *unseen_lines(result.fixed_unseen),
        *correction_lines(log.corrections, result.not_corrected),
        f"hand-eye: {len(handeye.q)} poses used, {len(handeye.missed)} missed; left out, a pose is "
        f"predicted to {1e3 * position:.2f} mm, {np.degrees(angle):.3f} deg RMS: the error of the arm's nominal table",
        *handeye.missed,
        f"delay of the images, by {'a sweep' if result.led is None else 'the sync LED'}:"
        f" {1e3 * delay.delay_s:.2f} ms, sigma {1e3 * delay.sigma_s:.2f} ms"
        if result.delay_found
        else f"the delay of the images was not measured: {1e3 * delay.delay_s:g} ms assumed",
        *([] if result.shutters is None else [f"exposures: {result.shutters}; {moved}"]),
        *([] if result.led is None else [str(result.led)]),
        _shots_line(result),
        *(f"{count} missed: {reason}" for reason, count in log.missed.most_common(5)),
        "commands: " + ", ".join(f"{count} {basis}" for basis, count in modes.most_common()),
        *([] if result.ended_text is None else [f"ended early: {result.ended_text}"]),
    ]


def _figures(
    result: RunResult,
    tracks: Tracks,
    passes: tuple[PassErrors, PassErrors] | None,
    studies: Sequence[Study],
    picture: Image | None,
    workcell: Callable[[], Image] | None,
) -> Mapping[str, Section]:
    begin_s, end_s = (-np.inf, -np.inf) if result.open_s is None else result.open_s
    run, alone = tracks.between(begin_s, most=_POINTS), tracks.between(begin_s, end_s, most=_POINTS)
    drawn: dict[str, Callable[[], Any]] = {
        "pose": lambda: picture,
        "workcell": workcell or (lambda: None),
        "joints": partial(figures.joints_figure, run),
        "path": partial(figures.path_figure, run),
        "errors": partial(figures.errors_figure, run),
        "loop": partial(figures.loop_figure, passes),
        "latency": partial(figures.latency_figure, result.log.latency_s.array(1)[:, 0]),
        "studies": partial(figures.studies_figure, studies),
        "overview": partial(figures.overview_figure, picture, alone, passes),
    }
    sections: dict[str, tuple[str, list[Block]]] = {}
    for name, draw in drawn.items():
        anchor, title, caption = _FIGURES[name]
        sections.setdefault(anchor, (title, []))[1].append(Plot(name, draw, caption, name, zoom=True))
    return sections
