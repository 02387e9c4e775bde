"""The motions of a test of ISO 9283 as a file that ``armsight run --motion`` takes, and what cameras see of them."""

from __future__ import annotations

import csv
import io
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.app.check import CYCLES, DRIFT_CYCLES, REQUIRED_CYCLES
from armsight.app.run.motion_file import read_motions
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_json, write_text
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
#: Where on the circle the motion starts, and by how much more than a whole revolution it is run, deg: neither the start nor
#: the end is evaluated.
START_DEG, OVER_DEG = 15.0, 60.0
#: Points of the body stay this far from the images' edges, px.
_MARGIN_PX = 20.0
#: Points of a path that are looked at for limits and visibility.
_LOOKED = 200
Allowed = Callable[[Array], NDArray[np.bool_]]


class PlannedTest(NamedTuple):
    """A test that was planned.

    Attributes:
        name: poses, wide, line or circle.
        cycles: how many times.
        plan: its poses and cube.
        motions: the motion file.
    """

    name: str
    cycles: int
    plan: CheckPlan
    motions: str

    @property
    def notes(self) -> list[str]:
        """What fewer cycles than the standard's leave out of the evaluation."""
        required = REQUIRED_CYCLES.get(self.name, 1)
        if self.cycles >= required:
            return []
        poses = self.name == "poses"
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
    """Plan a test.

    Args:
        arm: the nominal arm.
        name: which test.
        cycles: how many times; None for the usual.
        centre: (3,) of the cube, base, m; None to let it be found.
        speed_m_s: along lines and circles.
        visible_in: an earlier run, whose cameras must see all of it; None to let all be seen.

    Raises:
        InputError: no cube is within reach, or the run's files cannot be used.
    """
    allowed = everywhere if visible_in is None else seen_by(visible_in)
    paths = {"line": partial(_line, arm), "circle": partial(_circle, arm)}
    done = paths.get(name)
    too_fast: list[CheckPlan] = []  # cubes whose poses would do, but not the path

    def feasible(plan: CheckPlan) -> bool:
        good = done is None or _goes(arm, partial(done, plan, speed_m_s), allowed)
        too_fast.extend([] if good else [plan])
        return good

    try:
        plan = plan_check(arm, centre=centre, wide=name == "wide", allowed=allowed, feasible=feasible)
    except InputError as error:
        raise InputError(f"{error}{', or a lower --speed' if too_fast else ''}") from None
    times = CYCLES[name] if cycles is None else cycles
    texts = {"line": _line_text, "circle": _circle_text}

    def motions(cycles: int) -> str:
        return texts[name](arm, plan, cycles, speed_m_s) if name in texts else _poses_text(plan, cycles)

    with tempfile.TemporaryDirectory() as folder:  # it is planned as it will be; after two cycles all come again
        write_text(Path(folder) / "motion.toml", motions(min(times, 2)))
        read_motions(arm, Path(folder) / "motion.toml")
    head = f"# armsight check plan: {name}, {times} cycles, arm {arm.name}. Keys: docs/howto/motions.md.\n"
    return PlannedTest(name, times, plan, head + motions(times))


def _goes(arm: Arm, path: Callable[[], Trajectory], allowed: Allowed) -> bool:
    """Return whether the arm can follow a path, clear of its limits and, all along it, where it may be."""
    try:
        way = path()
    except InputError:
        return False
    q = way.at(np.linspace(0.0, way.duration_s, _LOOKED)).q
    inside = np.all((q > arm.q_min + CLEAR_RAD) & (q < arm.q_max - CLEAR_RAD))
    return bool(inside and allowed(arm.forward(q)).all())


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
    T_rig_base = inverse(T_base_rig)
    T_right_left = inverse(rig.T_left_right)

    def seen(Ts: Array) -> NDArray[np.bool_]:
        p_left = np.array([transform(T_rig_base @ T @ T_tool_body, body) for T in Ts])
        good = np.ones(len(Ts), bool)
        for camera, p in ((rig.left, p_left), (rig.right, transform(T_right_left, p_left.reshape(-1, 3)))):
            uv = camera.project(p.reshape(-1, 3)).reshape(len(Ts), -1, 2)
            with np.errstate(invalid="ignore"):
                inside = (uv > _MARGIN_PX) & (uv < np.array(camera.image_size_px) - _MARGIN_PX)
            good &= inside.all(axis=(1, 2)) & (p.reshape(len(Ts), -1, 3)[..., 2] > 0).all(axis=1)
        return good

    return seen


def _line(arm: Arm, plan: CheckPlan, speed_m_s: float) -> Trajectory:
    """Return the line across the cube, P2 to P4."""
    length = float(np.linalg.norm((plan.Ts_base_tool[3] - plan.Ts_base_tool[1])[:3, 3]))
    return line(arm, plan.q[1], plan.Ts_base_tool[3], duration_s=length / speed_m_s)


def _round(plan: CheckPlan, speed_m_s: float) -> tuple[Array, Array, float, float]:
    """Return where the circle begins (3,), its axis (3,), its angle, deg, and its duration, s."""
    axes = plane_axes(np.array([1.0, 0.0, -1.0]) / np.sqrt(2))  # the plane of the five poses
    a, radius = np.radians(START_DEG), RADIUS * plan.side_m
    angle = 360.0 + OVER_DEG
    start = plan.centre + radius * np.array([np.cos(a), np.sin(a)]) @ axes
    return start, np.cross(*axes), angle, float(np.radians(angle)) * radius / speed_m_s


def _circle(arm: Arm, plan: CheckPlan, speed_m_s: float) -> Trajectory:
    """Return the circle about P1, counter-clockwise."""
    start, axis, angle, duration_s = _round(plan, speed_m_s)
    return circle(arm, _start(arm, plan, start), plan.centre, axis, np.radians(angle), duration_s=duration_s)


def _start(arm: Arm, plan: CheckPlan, p_base: Array) -> Array:
    """Return joint angles (n,), rad, at a position (3,), base, m, in the configuration of the poses."""
    found = arm.inverse(pose(plan.Ts_base_tool[0][:3, :3], p_base), near=plan.q[0]).best
    if found is None:
        raise InputError("the circle is out of reach")
    return found


def _numbers(values: Array) -> str:
    """Return numbers (N,) as a motion file has them."""
    return "[" + ", ".join(f"{v:.6f}" for v in values) + "]"


def _joints(name: str, q: Array) -> str:
    """Return a motion to joint angles (n,), rad."""
    return f'\n[[motion]]\nkind = "joints"\nname = "{name}"\nq_deg = {_numbers(np.degrees(q))}\n'


def _poses_text(plan: CheckPlan, cycles: int) -> str:
    """Return the motions from pose to pose; where there are cycles, the first comes from the last, as every other does."""
    text = _joints(f"to {plan.names[-1]}", plan.q[-1]) if cycles > 1 else ""
    for cycle in range(1, cycles + 1):
        for name, q in zip(plan.names, plan.q, strict=True):
            text += _joints(f"{name} cycle {cycle}", q)
    return text


def _line_text(arm: Arm, plan: CheckPlan, cycles: int, speed_m_s: float) -> str:
    duration = _line(arm, plan, speed_m_s).duration_s
    text = _joints("to P2", plan.q[1])
    for cycle in range(1, cycles + 1):
        for way, goal in (("P2 to P4", 3), ("P4 to P2", 1)):
            to_mm = 1e3 * plan.Ts_base_tool[goal][:3, 3]
            text += f'\n[[motion]]\nkind = "line"\nname = "{way} cycle {cycle}"\nto_mm = {_numbers(to_mm)}\n'
            text += f"duration_s = {duration:.4f}\n"
    return text


def _circle_text(arm: Arm, plan: CheckPlan, cycles: int, speed_m_s: float) -> str:
    start, axis, angle, duration = _round(plan, speed_m_s)
    text = _joints("to the circle", _start(arm, plan, start))
    for cycle in range(1, cycles + 1):
        for way, sign in (("counter-clockwise", 1), ("clockwise", -1)):
            text += f'\n[[motion]]\nkind = "circle"\nname = "{way} cycle {cycle}"\n'
            text += f"center_mm = {_numbers(1e3 * plan.centre)}\naxis = {_numbers(axis)}\n"
            text += f"angle_deg = {sign * angle:.1f}\nduration_s = {duration:.4f}\n"
    return text


def plan_csv(plan: CheckPlan) -> str:
    """Return the poses as CSV, for an arm that another program moves: joint angles and the commanded pose."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = [f"command_{n}" for n in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")]
    writer.writerow(["pose", *(f"q{i + 1}_rad" for i in range(plan.q.shape[1])), *names])
    for name, q, T in zip(plan.names, plan.q, plan.Ts_base_tool, strict=True):
        writer.writerow([name, *(f"{v:.9f}" for v in (*q, *T[:3, 3], *quaternion_wxyz(T[:3, :3])))])
    return out.getvalue()


def plan_json(test: PlannedTest) -> dict[str, object]:
    """Return a plan as JSON has it, SI units."""
    return {
        "test": test.name,
        "cycles": test.cycles,
        "side_m": test.plan.side_m,
        "centre_m": test.plan.centre.tolist(),
        "poses": list(test.plan.names),
        "q_rad": test.plan.q.tolist(),
        "T_base_tool": test.plan.Ts_base_tool.tolist(),
        "notes": test.notes,
    }
