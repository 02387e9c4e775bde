"""A run without motion: shots of an arm that another program moved, and the joint angles that it logged (``poses:FILE``).

The angles are in a file that :mod:`armsight.tables` reads: a column a joint, ``q1_rad`` or ``q1_deg`` .., and ``shot`` (or
``image``, ``name``) or ``t_s`` (the clock of the images; rows between are interpolated); else a row a shot, in order.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.run.folder import write_handeye
from armsight.app.show.page import PAGE
from armsight.app.show.plotting import BLUE, Figure, subplots
from armsight.app.show.report import Lines, Report, Section, figures
from armsight.data import Array, Missed, PoseEstimate, Record
from armsight.errors import CalibrationError, InputError
from armsight.files import columns_unused, table_text
from armsight.geometry.pose import inverse
from armsight.loop.handeye.handeye import TRUSTED_M, TRUSTED_RAD, HandEye, calibrate_handeye, require_known
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.misread import check_plausible, without_tool
from armsight.loop.running.calibrate import HandEyeRun
from armsight.robot.kinematics.arm import Arm
from armsight.tables.poses import read_pose_table
from armsight.vision.markers.marker import Target
from armsight.vision.pose.measure import measure
from armsight.vision.rig import StereoRig
from armsight.vision.sources import Source

#: Angles at the time of a shot are interpolated between rows at most so far apart, s.
MOST_GAP_S = 0.25


@dataclass(frozen=True, eq=False)
class LoggedAngles(Record):
    """The rows of a file."""

    path: Path  #: of the file, for errors
    q: Array  #: (N, n) joint angles, rad; NaN in a row without, which is kept where rows belong together by order
    shots: tuple[str, ...] | None  #: names of the shots the rows belong to; None where no column has them
    t_s: Array | None  #: (N,) times of the rows, s, rising; None where no column has them
    notes: tuple[str, ...] = ()  #: what was found out while reading

    def at(self, names: Sequence[str], times_s: Sequence[float | None]) -> list[Array | None]:
        """Return the joint angles (n,), rad, at each shot; None at a shot that no row belongs to."""
        if self.shots is not None:
            rows = dict(zip(self.shots, self.q, strict=True))
            if not any(name in rows for name in names):
                first = f"the first row's shot is {self.shots[0]!r}, the first shot {names[0]!r}"
                raise InputError(f"{self.path}: no row is of one of the shots: {first}")
            return [rows.get(name) for name in names]
        if self.t_s is not None:
            return self._interpolated(times_s)
        if len(names) != len(self.q):
            give = "give a column shot or t_s, or a row for each shot"
            raise InputError(f"{self.path}: {len(self.q)} rows, but {len(names)} shots: {give}")
        return [q if np.isfinite(q).all() else None for q in self.q]

    def _interpolated(self, times_s: Sequence[float | None]) -> list[Array | None]:
        assert self.t_s is not None
        known = [t for t in times_s if t is not None]
        if not known:
            raise InputError(f"{self.path}: t_s says when rows are, but the shots have no times: give a column shot")
        found: list[Array | None] = []
        for t in times_s:
            k = int(np.searchsorted(self.t_s, -np.inf if t is None else t))
            if t is not None and k < len(self.t_s) and self.t_s[k] == t:
                found.append(self.q[k])
            elif t is None or not 0 < k < len(self.t_s) or self.t_s[k] - self.t_s[k - 1] > MOST_GAP_S:
                found.append(None)
            else:
                share = (t - self.t_s[k - 1]) / (self.t_s[k] - self.t_s[k - 1])
                found.append(self.q[k - 1] + share * (self.q[k] - self.q[k - 1]))
        if all(each is None for each in found):
            when = f"rows from {self.t_s[0]:.3f} to {self.t_s[-1]:.3f} s, shots from {min(known):.3f} to {max(known):.3f} s"
            raise InputError(f"{self.path}: no shot was taken while angles were logged: {when}: they need one clock")
        return found


def read_angles(path: str | Path, arm: Arm) -> LoggedAngles:
    """Read the logged joint angles of an arm; an InputError says what is wrong with them."""
    kept = read_pose_table(Path(path), arm=arm, only_joints=True, keep_missed=True)
    table = kept.without_missed()
    assert kept.q is not None
    assert table.q is not None
    t_s = table.t_s if table.names is None else None
    by_order = table.names is None and t_s is None
    q = np.where(np.array([[not why] for why in kept.missed]), kept.q, np.nan) if by_order else table.q
    if t_s is not None and len(fallen := np.flatnonzero(np.diff(t_s) <= 0)):
        raise InputError(f"{path}: line {table.lines[fallen[0] + 1]}: t_s does not rise: {t_s[fallen[0] + 1]:g} s")
    notes = (f"{path}: {columns_unused(table.unused)}",) if table.unused else ()
    return LoggedAngles(table.path, q, table.names, t_s, (*table.notes, *notes))


MIN_POSES = 12
#: Rows that belong to the neighbouring shots fit so many times better: then they are shifted.
_SHIFTED, _STEP_SHARE = 3.0, 0.2
SHIFTED = "the angles of the row {} fit every shot far better than its own: are rows and images shifted by one?"
_MOVED_RAD = float(np.radians(0.5))


@dataclass(frozen=True, eq=False)
class LoggedRun(Record):
    """The result."""

    run: HandEyeRun  #: the hand-eye calibration and its poses
    names: tuple[str, ...]  #: (N,) shots of its poses
    shots: int  #: how many shots there were
    unpaired: tuple[str, ...]  #: shots that no row of angles belongs to
    #: 1 where the angles of the row before fit the shots better than their own, -1 those of the row behind, else 0.
    shift: int
    implausible: str | None  #: why these angles cannot be this arm's; None where they can

    @property
    def error_mm(self) -> Array:
        """(N,) distance of the body from where the others' fit has it, mm; NaN of an outlier."""
        return 1e3 * self.run.found.held_out.position_m

    @property
    def error_deg(self) -> Array:
        """(N,) angle of the body to where the others' fit has it, degrees; NaN of an outlier."""
        return np.degrees(self.run.found.held_out.angle_rad)

    @property
    def weak(self) -> tuple[str, ...]:
        """Why the result must not be trusted; empty where nothing says so."""
        if not self.shift:
            return () if self.implausible is None else (self.implausible,)
        return (SHIFTED.format("before" if self.shift > 0 else "behind"),)

    def to_json(self) -> dict[str, Any]:
        """Return what summary.json has."""
        found, (position, angle) = self.run.found, self.run.found.held_out.rms()
        outliers = [name for name, used in zip(self.names, found.used, strict=True) if not used]
        shown: dict[str, Any] = {"shots": self.shots, "poses": len(self.names), "missed": list(self.run.missed)}
        shown |= {"without_angles": list(self.unpaired), "outliers": outliers}
        lengths_m = {"held_out_position_rms": position, "held_out_position_max": found.held_out.most()[0]}
        lengths_m["sigma_flange"] = found.sigma_flange[0]
        shown |= {f"{name}_mm": round(1e3 * each, 4) for name, each in lengths_m.items()}
        angles = {"held_out_angle_rms": angle, "sigma_flange": found.sigma_flange[1]}
        shown |= {f"{name}_deg": round(float(np.degrees(each)), 5) for name, each in angles.items()}
        return shown | {"share": found.structure, "rows_shifted_by": self.shift, "weak": list(self.weak)}


def run_logged(
    source: Source, rig: StereoRig, target: Target, arm: Arm, angles: LoggedAngles, progress: Callable[[str], None]
) -> LoggedRun:
    """Measure every shot and calibrate hand and eye with the logged angles."""
    names, seen, q_all = _measured(source, rig, target, angles, progress)
    rows = list(zip(names, seen, q_all, strict=True))
    unpaired = tuple(name for name, _, q in rows if q is None)
    missed = tuple(f"{name}: {r.reason}" for name, r, _ in rows if isinstance(r, Missed))
    good = [(name, r, q) for name, r, q in rows if isinstance(r, PoseEstimate) and q is not None]
    if len(good) < MIN_POSES:
        few = f"{len(good)} of {len(names)} shots show the body and have joint angles; {MIN_POSES} at least are needed"
        raise CalibrationError(": ".join([few, *missed[:1]]))
    q = np.array([angles_of for _, _, angles_of in good])
    Ts, covs = np.array([pose.T_left_body for _, pose, _ in good]), np.array([pose.cov for _, pose, _ in good])
    progress("hand-eye: calibrating")
    centre = target.body.points.mean(axis=0)
    found = _required(arm, q, Ts, covs, centre)
    steps = np.diff(q, axis=0, prepend=q[:1])
    approach = np.sign(np.where(np.abs(steps) > _MOVED_RAD, steps, 0.0))
    run = HandEyeRun.of(arm, found, q, Ts, covs, approach, missed)
    progress("hand-eye: are rows and shots shifted, are the angles this arm's?")
    shift = _shift(arm, q, Ts, covs, centre, found.held_out.rms()[0])
    implausible = None if shift else _implausible(arm, q[found.used], Ts[found.used])
    if not shift and implausible is None:
        require_known(found, Ts, TRUSTED_M, TRUSTED_RAD)
    return LoggedRun(run, tuple(name for name, _, _ in good), len(names), unpaired, shift, implausible)


def _required(arm: Arm, q: Array, Ts: Array, covs: Array, centre: Array) -> HandEye:
    """Calibrate hand and eye; raise a CalibrationError that says what is wrong with the rows, where that is known."""
    found = _calibrated(arm, q, Ts, covs, centre)
    if isinstance(found, HandEye):
        return found
    shift = _shift(arm, q, Ts, covs, centre, np.inf)
    why = SHIFTED.format("before" if shift > 0 else "behind") if shift else _implausible(arm, q, Ts)
    raise found if why is None else CalibrationError(f"{why} ({found})")


def _measured(
    source: Source, rig: StereoRig, target: Target, angles: LoggedAngles, progress: Callable[[str], None]
) -> tuple[list[str], list[PoseEstimate | Missed], list[Array | None]]:
    names, times, seen = list[str](), list[float | None](), list[PoseEstimate | Missed]()
    while (shot := source.read()) is not None:
        progress(f"measuring shot {len(names) + 1}")
        names.append(shot.name)
        times.append(shot.t_s)
        seen.append(measure(rig, target, shot))
    if not names:
        raise CalibrationError("the source has no shot")
    return names, seen, angles.at(names, times)


def _implausible(arm: Arm, q: Array, Ts_left_body: Array) -> str | None:
    """Return why the angles of poses cannot be this arm's, with what would make them fit; None where they can."""
    try:
        check_plausible(without_tool(arm), Measured(q, Ts_left_body[:, None, :3, 3], Ts_left_body[:, :3, :3]))
    except InputError as error:
        return str(error)
    return None


def _calibrated(
    arm: Arm, q: Array, Ts: Array, covs: Array, centre: Array, quick: bool = False
) -> HandEye | CalibrationError:
    try:
        return calibrate_handeye(arm.forward(q) @ inverse(arm.T_flange_tool), Ts, covs, centre=centre, quick=quick)
    except CalibrationError as error:
        return error


def _shift(arm: Arm, q_all: Array, Ts_all: Array, covs_all: Array, centre: Array, own: float) -> int:
    """Return by how many rows the angles seem to be late: 1, -1, or 0; ``own`` is the held-out error of none, m."""
    steps_m = np.linalg.norm(np.diff(Ts_all[:, :3, 3], axis=0), axis=1)
    if own < _STEP_SHARE * np.median(steps_m):  # a shift makes errors as large as the steps from pose to pose
        return 0
    best, shift = (own if np.isfinite(own) else float(np.median(steps_m))) / _SHIFTED, 0
    for late in (1, -1):
        rows, shots = (slice(None, -1), slice(1, None))[::late]
        q, Ts, covs = q_all[rows], Ts_all[shots], covs_all[shots]
        other = _calibrated(arm, q, Ts, covs, centre, True)
        if isinstance(other, HandEye) and other.used.mean() > 0.8 and other.held_out.rms()[0] < best:
            best, shift = other.held_out.rms()[0], late
    return shift


def write_logged(folder: Path, result: LoggedRun, properties: dict[str, str]) -> dict[str, Any]:
    """Write the files of a run without motion and return its summary."""
    summary = {**properties, **result.to_json()}
    write_handeye(folder, result.run)
    names = ["shot", *(f"q{k + 1}_deg" for k in range(result.run.q.shape[1])), "error_mm", "error_deg", "used"]
    run = result.run
    each = zip(result.names, np.degrees(run.q), result.error_mm, result.error_deg, run.found.used, strict=True)
    rows = ([name, *np.round(q, 4), _rounded(mm), _rounded(deg), int(used)] for name, q, mm, deg, used in each)
    files = {"errors.csv": table_text(names, rows), "summary.json": json.dumps(summary, indent=1) + "\n"}
    _report(result, summary).write(folder, files)
    return summary


def summary_lines(summary: dict[str, Any], folder: Path) -> list[str]:
    """Return a summary for people: mm and degrees."""
    return [
        f"{summary['poses']} of {summary['shots']} shots measured with joint angles"
        + (f", {len(summary['outliers'])} outliers" if summary["outliers"] else ""),
        f"left out of the fit: {summary['held_out_position_rms_mm']:.3f} mm RMS"
        f" ({summary['held_out_position_max_mm']:.3f} at most), {summary['held_out_angle_rms_deg']:.3f} deg RMS",
        f"of it the arm by its joints: sigma {summary['sigma_flange_mm']:.3f} mm an axis",
        f"{folder / PAGE}",
        f"next, what explains it: armsight identify --arm {summary['arm']} --data {folder / 'handeye_poses.csv'} -o DIR",
    ]


def _rounded(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.4f}"


def _report(result: LoggedRun, summary: dict[str, Any]) -> Report:

    def errors() -> Figure:
        figure, (top, bottom) = subplots(3.6, 2, 1, sharex=True)
        at = np.arange(len(result.names))
        top.bar(at, result.error_mm, color=BLUE)
        top.set_title("distance of the body, mm")
        bottom.bar(at, result.error_deg, color=BLUE)
        bottom.set(title="angle, deg", xlabel="pose")
        bottom.xaxis.get_major_locator().set_params(integer=True)
        return figure

    measured, headline, *lines, _, following = summary_lines(summary, Path())
    outliers = [f"{name}: an outlier" for name in summary["outliers"]]
    missed = [*result.run.missed, *(f"{name}: no joint angles" for name in result.unpaired), *outliers]
    caption = "Good: no pose stands out, and nothing drifts from the first to the last."
    said = Lines([*result.weak, measured, *lines, f"board {summary['board']}", following])
    sub = "The arm was moved by another program; each pose is predicted by a fit to the others."
    sections: dict[str, Section] = {"result": ("Result", [said])}
    sections |= figures({"errors": (errors, "Error of each pose left out of the fit", caption)})
    sections["missed"] = "Shots that were not used", [Lines(missed, none="none")]
    return Report("run", f"{summary['arm']}: logged poses", sub, headline, sections)
