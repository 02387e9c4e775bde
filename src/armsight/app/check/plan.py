"""The motions of a test of ISO 9283 as a file that ``armsight run --motion`` takes, and what cameras see of them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.app.check import CYCLES, DRIFT_CYCLES, REQUIRED_CYCLES
from armsight.app.run.motion_file import motion_text, read_motions
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_json, table_text, write_text
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse, pose, transform
from armsight.geometry.rotation import quaternion_wxyz
from armsight.loop.iso9283.paths import plane_axes
from armsight.loop.iso9283.plan import CLEAR_RAD, CheckPlan, everywhere, plan_check
from armsight.loop.iso9283.poses import MIN_POSES
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import Trajectory, circle, line
from armsight.vision.markers.targets import open_target
from armsight.vision.rig import StereoRig

#: The circle's radius, in sides of the cube (8.2: its diameter is 80 % of it).
RADIUS = 0.4
#: Where on the circle the motion starts, and by how much more than a revolution it runs, deg: neither end is evaluated.
START_DEG, OVER_DEG = 15.0, 60.0
#: Points of the body stay this far from the images' edges, px; points of a path are looked at for limits and visibility.
_MARGIN_PX, _LOOKED = 20.0, 200
Allowed = Callable[[Array], NDArray[np.bool_]]


class PlannedTest(NamedTuple):
    """A test that was planned."""

    name: str  #: poses, wide, line or circle
    cycles: int  #: how many times
    plan: CheckPlan  #: its poses and cube
    motions: str  #: the motion file

    @property
    def notes(self) -> list[str]:
        """What fewer cycles than the standard's leave out of the evaluation."""
        required, poses = REQUIRED_CYCLES.get(self.name, 1), self.name == "poses"
        if self.cycles >= required:
            return []
        if self.cycles < MIN_POSES:
            what = "pose attained" if poses else "path followed"
            lost = f"`armsight check` leaves out every {what} fewer than {MIN_POSES} times: there will be no accuracy, "
            lost += "repeatability, distance and drift" if poses else "and no repeatability"
        else:
            lost = "the intervals of repeatability will be wide (docs/howto/iso9283.md)"
            lost += f", and drift needs {DRIFT_CYCLES} cycles" if poses and self.cycles < DRIFT_CYCLES else ""
        return [f"{self.cycles} of the {required} cycles that ISO 9283 requires: {lost}"]


def plan_test(
    arm: Arm, name: str, cycles: int | None, centre: Array | None, speed_m_s: float, visible_in: Path | None
) -> PlannedTest:
    """Plan a test about ``centre`` (3,), base, m, or where it fits; ``visible_in``: a run whose cameras see it all."""
    allowed = everywhere if visible_in is None else seen_by(visible_in)
    path = {"line": _line, "circle": _circle}.get(name)
    too_fast: list[CheckPlan] = []  # cubes whose poses would do, but not the path

    def feasible(plan: CheckPlan) -> bool:
        good = path is None or _goes(arm, partial(path, arm, plan, speed_m_s), allowed)
        too_fast.extend([] if good else [plan])
        return good

    try:
        plan = plan_check(arm, centre=centre, wide=name == "wide", allowed=allowed, feasible=feasible)
    except InputError as error:
        raise InputError(f"{error}{', or a lower --speed' if too_fast else ''}") from None
    times = CYCLES[name] if cycles is None else cycles

    def motions(cycles: int) -> str:
        # Where there are cycles, the first pose comes from the last, as every other does.
        poses = [("joints", at, {"q_deg": np.degrees(q)}) for at, q in zip(plan.names, plan.q, strict=True)]
        last = (f"to {plan.names[-1]}", plan.q[-1]) if cycles > 1 else None
        begin, each = (last, poses) if path is None else path(arm, plan, speed_m_s)[1:]
        first = "" if begin is None else motion_text("joints", begin[0], {"q_deg": np.degrees(begin[1])})
        numbered = [(kind, f"{at} cycle {n}", keys) for n in range(1, cycles + 1) for kind, at, keys in each]
        return first + "".join(motion_text(*motion) for motion in numbered)

    with tempfile.TemporaryDirectory() as folder:  # it is planned as it will be; after two cycles all come again
        write_text(Path(folder) / "motion.toml", motions(min(times, 2)))
        read_motions(arm, Path(folder) / "motion.toml")
    head = f"# armsight check plan: {name}, {times} cycles, arm {arm.name}. Keys: docs/howto/motions.md.\n"
    return PlannedTest(name, times, plan, head + motions(times))


def seen_by(run: Path) -> Allowed:
    """Return a function: whether both cameras of a run see all of its body at poses (N, 4, 4) of the tool."""
    rig, body = StereoRig.load(run / "rig.json"), open_target(str(run / "body.toml")).body.points
    file = run / "handeye.json"
    try:
        document = read_json(file)
        T_base_rig, T_tool_body = (checked(document[key], (4, 4), key) for key in ("T_base_rig", "T_tool_body"))
    except InputError as error:
        raise InputError(f"{file}: {error}" if str(file) not in str(error) else str(error)) from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{file}: not a run's hand-eye calibration: T_base_rig and T_tool_body are needed") from None
    T_rig_base, T_right_left = inverse(T_base_rig), inverse(rig.T_left_right)

    def seen(Ts: Array) -> NDArray[np.bool_]:
        p_left = transform((T_rig_base @ Ts @ T_tool_body)[:, None], body)
        good = np.ones(len(Ts), bool)
        for camera, p in ((rig.left, p_left), (rig.right, transform(T_right_left, p_left))):
            uv = camera.project(p.reshape(-1, 3)).reshape(len(Ts), -1, 2)
            with np.errstate(invalid="ignore"):
                inside = (uv > _MARGIN_PX) & (uv < np.array(camera.image_size_px) - _MARGIN_PX)
            good &= inside.all(axis=(1, 2)) & (p[..., 2] > 0).all(axis=1)
        return good

    return seen


class _Path(NamedTuple):
    way: Trajectory
    begin: tuple[str, Array]  #: name of the motion to where it begins, and joint angles (n,), rad
    motions: list[tuple[str, str, dict[str, Any]]]  #: kinds, names and keys of a cycle's motions


def _goes(arm: Arm, path: Callable[[], _Path], allowed: Allowed) -> bool:
    """Return whether the arm can follow a path, clear of its limits and, all along it, where it may be."""
    try:
        way = path().way
    except InputError:
        return False
    q = way.at(np.linspace(0.0, way.duration_s, _LOOKED)).q
    inside = np.all((q > arm.q_min + CLEAR_RAD) & (q < arm.q_max - CLEAR_RAD))
    return bool(inside and allowed(arm.forward(q)).all())


def _line(arm: Arm, plan: CheckPlan, speed_m_s: float) -> _Path:
    Ts = plan.Ts_base_tool
    way = line(arm, plan.q[1], Ts[3], duration_s=float(np.linalg.norm((Ts[3] - Ts[1])[:3, 3])) / speed_m_s)
    goals = {"P2 to P4": 1e3 * Ts[3, :3, 3], "P4 to P2": 1e3 * Ts[1, :3, 3]}
    keys = [("line", name, {"to_mm": p, "duration_s": way.duration_s}) for name, p in goals.items()]
    return _Path(way, ("to P2", plan.q[1]), keys)


def _circle(arm: Arm, plan: CheckPlan, speed_m_s: float) -> _Path:
    """Return the circle about P1 in the plane of the five poses, counter-clockwise, and clockwise."""
    axes, radius = plane_axes(np.array([1.0, 0.0, -1.0]) / np.sqrt(2)), RADIUS * plan.side_m
    a, angle, axis = np.radians(START_DEG), 360.0 + OVER_DEG, np.cross(*axes)
    start = plan.centre + radius * np.array([np.cos(a), np.sin(a)]) @ axes
    # In the configuration of the poses.
    q = arm.inverse(pose(plan.Ts_base_tool[0][:3, :3], start), near=plan.q[0]).best
    if q is None:
        raise InputError("the circle is out of reach")
    duration_s = float(np.radians(angle)) * radius / speed_m_s
    way = circle(arm, q, plan.centre, axis, np.radians(angle), duration_s=duration_s)
    keys = {"center_mm": 1e3 * plan.centre, "axis": axis}
    ways = {"counter-clockwise": angle, "clockwise": -angle}
    motions = [("circle", name, {**keys, "angle_deg": at, "duration_s": duration_s}) for name, at in ways.items()]
    return _Path(way, ("to the circle", q), motions)


def plan_csv(plan: CheckPlan) -> str:
    """Return the poses as CSV, for an arm that another program moves: joint angles and the commanded pose."""
    names = [f"command_{n}" for n in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")]
    rows = (
        [name, *(f"{v:.9f}" for v in (*q, *T[:3, 3], *quaternion_wxyz(T[:3, :3])))]
        for name, q, T in zip(plan.names, plan.q, plan.Ts_base_tool, strict=True)
    )
    return table_text(["pose", *(f"q{i + 1}_rad" for i in range(plan.q.shape[1])), *names], rows)


def plan_json(test: PlannedTest) -> dict[str, object]:
    """Return a plan as JSON has it, SI units."""
    plan, arrays = test.plan, {"centre_m": "centre", "q_rad": "q", "T_base_tool": "Ts_base_tool"}
    shown = {"test": test.name, "cycles": test.cycles, "side_m": plan.side_m, "poses": list(plan.names)}
    return {**shown, **{key: getattr(plan, name).tolist() for key, name in arrays.items()}, "notes": test.notes}
