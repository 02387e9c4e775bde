"""The summary of a run: what summary.json holds, and the tables that the report and the terminal show of it.

In: what a run measured. Out: a :class:`RunSummary`; its JSON is made in :meth:`RunSummary.to_json` alone, its tables in
:func:`track_table` and :func:`loop_table` alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from armsight.app.run.experiment import RunResult
from armsight.app.run.metrics import (
    Spread,
    Study,
    TrackMetrics,
    evaluated_track,
    partly_uncorrected,
    path_errors,
    rest_errors,
    rms,
    spread,
    track_metrics,
)
from armsight.app.run.motion_file import MotionPlan
from armsight.app.run.record import RunData, ToolTrack
from armsight.app.show.encode import json_of
from armsight.app.show.messages import UNTRUSTED, colour, weak
from armsight.app.show.table import TextTable, plain_text
from armsight.loop.health import HealthFinding, health_lines, unseen_lines
from armsight.loop.health.follow import RigCorrection, correction_lines
from armsight.robot.kinematics.arm import Arm
from armsight.vision.rig import Shutters

#: Version of the files of a run's folder; version 1 named the reference track and the reference angles differently.
VERSION = 2
#: Track -> its name in tables.
TRACKS = {
    "potentiometers": "joint readings by the nominal arm",
    "vision": "vision",
    "fused": "fused, smoothed",
    "live": "fused, live",
}
_DEG = float(np.degrees(1.0))


@dataclass(frozen=True)
class Occlusion:
    """Errors of the estimates while the body was hidden on purpose, for ``duration_s`` seconds."""

    duration_s: float
    fused: TrackMetrics
    live: TrackMetrics


@dataclass(frozen=True)
class PassErrors:
    """Distance of the tool from its reference in one pass of the motions.

    Attributes:
        rest_m: RMS at the rests, m; None without any.
        rest_max_m: the largest at a rest, m.
        path_m: RMS along lines and circles, m; None without any.
        singular_m: at each rest at which the servo corrects only in part, by its name, m; not in ``rest_m``.
    """

    rest_m: float | None
    rest_max_m: float | None
    path_m: float | None
    singular_m: Mapping[str, float]


@dataclass(frozen=True)
class HandEyeSummary:
    """RMS errors of the hand-eye calibration on held-out poses, m and rad, and the number of poses."""

    held_out_position_rms_m: float
    held_out_angle_rms_rad: float
    poses: int


@dataclass(frozen=True)
class ShotCounts:
    """Numbers of shots: measured, missed (no pose), rejected by the estimator.

    Attributes:
        reopened: how many times measurements contradicted what the estimator had learned, so that it opened it again.
        misfit_max: the largest misfit of a measured pose, 1 where the residuals are within chance.
    """

    measured: int
    missed: int
    rejected: int
    reopened: int
    misfit_max: float


@dataclass(frozen=True)
class RunSummary:
    """The result of a run in numbers.

    Attributes:
        properties: what the run was of, as summary.json names it: arm, board, seed, cameras.
        wall_s: how long the run took, s.
        ended_by: what ended the run early; None where it ran to its end.
        tracks: errors of the tracks in motion, by their names; empty without a truth.
        occlusion: errors while the body was hidden; None where it was not, or without a truth.
        passes: errors with potentiometers alone and with the loop closed; None where not both were made.
        singular_rests: names of the rests at which the servo corrects only in part.
        latency: computing time from image to command while the body is followed, s; None without images.
        search: the same where the body was searched, and commands continued meanwhile, s; None without a search.
        handeye: the hand-eye calibration; None where the run ended before it.
        delay_s: delay of the cameras' time stamps, s, and its sigma, s.
        shutters: when the cameras expose, given or found by the sweep; None where they do at one time.
        shots: numbers of shots.
        studies: error of vision against one quantity after the other.
        health: why the result must not be trusted; empty where nothing says so.
        fixed_unseen: names of the fixed bodies that were seen too rarely to be watched.
        corrections: what was put right of a rig that was followed.
        not_corrected: why what else was found of it was not; None where nothing was left.
        sync_led: what the sync LED says, as JSON; None without one.
    """

    properties: Mapping[str, Any]
    wall_s: float
    ended_by: str | None
    tracks: Mapping[str, TrackMetrics]
    occlusion: Occlusion | None = None
    passes: tuple[PassErrors, PassErrors] | None = None
    singular_rests: tuple[str, ...] = ()
    latency: Spread | None = None
    search: Spread | None = None
    handeye: HandEyeSummary | None = None
    delay_s: tuple[float, float] | None = None
    shutters: Shutters | None = None
    shots: ShotCounts | None = None
    studies: Sequence[Study] = ()
    health: Sequence[HealthFinding] = ()
    fixed_unseen: Sequence[str] = ()
    corrections: Sequence[RigCorrection] = ()
    not_corrected: str | None = None
    sync_led: Mapping[str, Any] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the object of summary.json, SI units in the keys; numbers that are not known are None."""
        found: dict[str, Any] = {"version": VERSION}
        found |= {name: _track_json(metrics) for name, metrics in self.tracks.items()}
        if self.occlusion is not None:
            found["occlusion"] = {"duration_s": self.occlusion.duration_s}
            for name, metrics in (("fused", self.occlusion.fused), ("live", self.occlusion.live)):
                found["occlusion"][f"{name}_position_rms_m"] = metrics.position_rms_m
                found["occlusion"][f"{name}_position_max_m"] = metrics.position_max_m
        if self.passes is not None:
            found["closed_loop"] = _passes_json(self.passes, self.singular_rests)
        if self.latency is not None:
            found["latency_s"] = asdict(self.latency)
        if self.search is not None:
            found["search_s"] = asdict(self.search)
        if self.handeye is not None:
            found["handeye"] = asdict(self.handeye)
        if self.delay_s is not None:
            found["camera_delay_s"] = {"value": self.delay_s[0], "sigma": self.delay_s[1]}
        if self.shutters is not None:
            found["shutters"] = self.shutters.to_json()
        if self.sync_led is not None:
            found["sync_led"] = dict(self.sync_led)
        if self.shots is not None:
            found["shots"] = asdict(self.shots)
        if self.handeye is not None:
            found["studies"] = [_study_json(study) for study in self.studies]
        found["health"] = [each.to_json() for each in self.health]
        found["fixed_unseen"] = list(self.fixed_unseen)
        found["rig_corrections"] = [each.to_json() for each in self.corrections]
        found["rig_not_corrected"] = self.not_corrected
        found |= {**self.properties, "wall_s": self.wall_s, "ended_by": self.ended_by}
        known: dict[str, Any] = json_of(found)
        return known


def _track_json(metrics: TrackMetrics) -> dict[str, Any]:
    """Return the JSON object of a track; what was not evaluated is left out."""
    found = asdict(replace(metrics, claimed=None))
    rest = found.pop("rest_position_rms_m")
    found.pop("claimed")
    if metrics.claimed is not None:
        found |= asdict(metrics.claimed)
    return found if rest is None else {**found, "rest_position_rms_m": rest}


def _passes_json(passes: tuple[PassErrors, PassErrors], singular_rests: Sequence[str]) -> dict[str, Any]:
    """Return the JSON object of the two passes, "before" and "after" closing the loop."""
    named = (("before", passes[0]), ("after", passes[1]))
    found: dict[str, Any] = {
        "singular_rests": {
            name: {f"rest_error_{when}_m": each.singular_m[name] for when, each in named if name in each.singular_m}
            for name in singular_rests
        }
    }
    for when, each in named:
        values = {
            f"rest_error_{when}_m": each.rest_m,
            f"rest_error_{when}_max_m": each.rest_max_m,
            f"path_error_{when}_m": each.path_m,
        }
        found |= {key: value for key, value in values.items() if value is not None}
    return found


def _study_json(study: Study) -> dict[str, Any]:
    """Return the JSON object of a study."""
    return {
        "name": study.name,
        "unit": study.unit,
        "values": study.values.tolist(),
        "position_rms_m": study.position_rms_m.tolist(),
        "predicted_m": study.predicted_m.tolist(),
    }


def summary_of(
    arm: Arm,
    result: RunResult,
    plan: MotionPlan,
    run: RunData,
    before: RunData | None,
    after: RunData | None,
    studies: Sequence[Study],
    properties: Mapping[str, Any],
    wall_s: float,
) -> RunSummary:
    """Return the summary of a run.

    Args:
        arm: the nominal arm.
        result: what was measured; its hand-eye calibration is known.
        plan: the motions.
        run: all tracks.
        before: the pass with potentiometers alone; None where it was not made.
        after: the pass with the loop closed; None likewise.
        studies: made after the run.
        properties: what the run was of.
        wall_s: how long it took, s.
    """
    assert result.handeye is not None
    passes: tuple[PassErrors, PassErrors] | None = None
    singular_rests: tuple[str, ...] = ()
    if before is not None and after is not None:
        goals = {m.name: m.trajectory.at(m.trajectory.duration_s).q for m in plan.motions}
        singular_rests = tuple(name for name, q in goals.items() if partly_uncorrected(arm, q))
        passes = _pass_errors(before, singular_rests), _pass_errors(after, singular_rests)
    return RunSummary(
        properties,
        wall_s,
        result.ended_text,
        {} if before is None else _against_truth(before, result.covered_s),
        None if before is None else _occlusion(before, result.covered_s),
        passes,
        singular_rests,
        spread(run.latency_s) if len(run.latency_s) else None,
        spread(run.search_s) if len(run.search_s) else None,
        HandEyeSummary(*result.handeye.found.held_out.rms(), len(result.handeye.q)),
        (result.delay.delay_s, result.delay.sigma_s),
        result.shutters,
        ShotCounts(len(run.vision), run.missed, run.rejected, run.reopened, run.misfit_max),
        studies,
        result.health,
        result.fixed_unseen,
        result.log.corrections,
        result.not_corrected,
        None if result.led is None else result.led.to_json(),
    )


def _against_truth(before: RunData, covered_s: tuple[float, float] | None) -> dict[str, TrackMetrics]:
    """Return the errors of each track in motion and at rest, while the body was not hidden; empty without a truth."""
    found: dict[str, TrackMetrics] = {}
    if before.truth is None:
        return found
    tracks = {
        "vision": before.vision,
        "potentiometers": before.potentiometers,
        "fused": before.fused,
        "live": before.live,
    }
    for name, track in tracks.items():
        seen = ~_hidden(track, covered_s)
        moving, resting = (track.phase == "open_loop") & seen, (track.phase == "rest") & seen
        if moving.any() and resting.any():
            at_rest = track_metrics(track[resting], before.truth).position_rms_m
            found[name] = replace(track_metrics(track[moving], before.truth), rest_position_rms_m=at_rest)
    return found


def _occlusion(before: RunData, covered_s: tuple[float, float] | None) -> Occlusion | None:
    """Return the errors of the estimates while the body was hidden; None where it was not, or without a truth."""
    if before.truth is None or covered_s is None or not (before.t_s > covered_s[0]).any():
        return None
    fused, live = (
        track_metrics(track[_hidden(track, covered_s)], before.truth) for track in (before.fused, before.live)
    )
    return Occlusion(float(np.ptp(covered_s)), fused, live)


def _pass_errors(run: RunData, singular_rests: Sequence[str]) -> PassErrors:
    """Return the errors of one pass; rests at which the arm is nearly singular stand apart: it cannot be moved freely."""
    rests = rest_errors(run, evaluated_track(run))
    singular = {name: rests.pop(name) for name in singular_rests if name in rests}
    paths = [distances for _, distances in path_errors(run, evaluated_track(run)).values()]
    return PassErrors(
        rms(np.array(list(rests.values()))) if rests else None,
        max(rests.values()) if rests else None,
        rms(np.concatenate(paths)) if paths else None,
        singular,
    )


def _hidden(track: ToolTrack, covered_s: tuple[float, float] | None) -> NDArray[np.bool_]:
    """Return (N,) which rows lie where the body was hidden on purpose, or just after."""
    if covered_s is None:
        return np.zeros(len(track), bool)
    return (track.t_s > covered_s[0] - 0.01) & (track.t_s < covered_s[1] + 0.05)


def track_table(summary: RunSummary) -> TextTable | None:
    """Return the table of the tracks' errors in motion; None without a truth."""
    if not summary.tracks:
        return None
    columns = ("", "RMS, mm", "max, mm", "at rest, mm", "RMS, deg", "max, deg", "sigma, mm", "sigma, deg", "inside 95%")
    rows = []
    for name, shown in TRACKS.items():
        if (t := summary.tracks.get(name)) is not None:
            rest, c = t.rest_position_rms_m, t.claimed
            rows.append(
                (
                    shown,
                    f"{1e3 * t.position_rms_m:.3f}",
                    f"{1e3 * t.position_max_m:.3f}",
                    "–" if rest is None else f"{1e3 * rest:.3f}",
                    f"{_DEG * t.orientation_rms_rad:.3f}",
                    f"{_DEG * t.orientation_max_rad:.3f}",
                    "–" if c is None else f"{1e3 * c.position_sigma_rms_m:.3f}",
                    "–" if c is None else f"{_DEG * c.orientation_sigma_rms_rad:.3f}",
                    "–" if c is None else f"{100 * c.inside_95_share:.0f}%",
                )
            )
    return TextTable(
        "Error of the tool pose in motion, against the truth; sigma as claimed (RMS)", columns, tuple(rows)
    )


def loop_table(summary: RunSummary) -> TextTable | None:
    """Return the table of what closing the loop gained; None where not both passes were made."""
    if summary.passes is None:
        return None
    before, after = summary.passes
    rows = [
        (name, f"{1e3 * alone:.3f}", f"{1e3 * closed:.3f}", f"{alone / closed:.1f}")
        for name, alone, closed in (
            ("at rest, RMS", before.rest_m, after.rest_m),
            ("from the path, RMS", before.path_m, after.path_m),
        )
        if alone is not None and closed is not None
    ]
    columns = ("", "open loop, mm", "loop closed, mm", "times smaller")
    return TextTable("Distance of the tool from its command", columns, tuple(rows))


def show_summary(summary: RunSummary, folder: Path, *, as_json: bool) -> None:
    """Print a run's summary on stdout, mm and degrees or JSON; end with UNTRUSTED where it must not be trusted."""
    if as_json:
        click.echo(json.dumps(summary.to_json()))
    else:
        _print(summary, folder)
    if any(each.forbids for each in summary.health):
        click.get_current_context().exit(UNTRUSTED)


def _print(summary: RunSummary, folder: Path) -> None:
    for table in (track_table(summary), loop_table(summary)):
        if table is not None:
            click.echo(plain_text(table))
    for line in health_lines(summary.health):
        click.echo(weak(line), err=True, color=colour())
    for line in (*unseen_lines(summary.fixed_unseen), *correction_lines(summary.corrections, summary.not_corrected)):
        click.echo(f"note: {line}", err=True)
    lines = []
    if (hidden := summary.occlusion) is not None:
        lines.append(
            f"body hidden for {hidden.duration_s:g} s in motion: the fused estimate was wrong by at most "
            f"{1e3 * hidden.fused.position_max_m:.2f} mm"
        )
    if (t := summary.latency) is not None:
        lines.append(
            f"image to command: p50 {1e3 * t.p50:.2f} ms, p99 {1e3 * t.p99:.2f} ms, p99.9 {1e3 * t.p999:.2f} ms, "
            f"longest {1e3 * t.max:.1f} ms while the body is followed"
        )
    if (t := summary.search) is not None:
        lines.append(
            f"search of the body: median {1e3 * t.p50:.0f} ms, longest {1e3 * t.max:.0f} ms; commands continue meanwhile"
        )
    if (shots := summary.shots) is not None:
        lines.append(
            f"{shots.measured} shots measured, {shots.missed} missed, {shots.rejected} rejected by the estimator; run.log "
            "has the reasons"
        )
    lines.append(f"{folder / 'report.html'} shows the run; {summary.wall_s:.0f} s")
    click.echo("\n".join(lines))
