"""References beside vision: what they are worth, in the simulated workcell and on public recordings.

python references.py hidden [N]     body hidden for 0.5, 2, 5 s on the circle, N worn arms (10), joints alone: a minute each
python references.py fused [N [SEED]]   the same with an inertial unit, as replay --references fuses it, seeds from 4 on (4)
python references.py jumps [N [SEED]]   the camera's clock jumps by 3, 10, -10 ms in motion, with a unit and without
python references.py tilt [N]       base's tilt and the zeros that gravity shows, N simulated worn arms (40): a minute
python references.py gravity        direction of gravity at rest, arm-imu, calibrated by the other take: half a minute

Public recordings lie where ARMSIGHT_DATA points.
"""

import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from armsight.app.demo import demo
from armsight.app.demo.demo import true_track
from armsight.app.replay.open import Request, replay
from armsight.app.run.folder import run_in
from armsight.app.run.metrics import track_metrics
from armsight.app.run.tracks import Tracks
from armsight.data import Array
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3, from_quaternion_wxyz
from armsight.loop.estimators import KalmanEstimator, Outcome, PoseMeasurement
from armsight.loop.identify.gravity import gravity_shows
from armsight.loop.references.calibrate import PosePath, calibrate
from armsight.loop.references.file import COLUMNS, Entry, written
from armsight.loop.references.inertial import ACCELEROMETER, GYRO, INERTIAL_CLASSES, Inertial
from armsight.loop.references.reference import STANDARD_GRAVITY_M_S2, Reading, ToolMotion
from armsight.sim.references.inertial import InertialErrors, record
from armsight.sim.workcell.workcell import Workcell

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "loop"))
from worn_arm import poses, worn

#: How long the body is hidden, s, and the circle, from 0, on which that begins.
HIDDEN = ((0.5, 0), (2.0, 1), (5.0, 2))
CIRCLE_S, REST_S = 3.2, 0.5
DATA = Path(os.environ.get("ARMSIGHT_DATA", Path(__file__).resolve().parents[1] / "../shared/data"))
#: What a calibration left of the sensor: rotation, bias, M_a; the tilt is not known.
LEFT = np.full(38, 1e-9)
LEFT[:3], LEFT[9:12], LEFT[12:18], LEFT[36:] = np.radians(0.05), 0.01, 5e-4, np.radians(5.0)
RESTS = 120
#: What a sweep leaves of a unit's parameters: rotation, lever, biases, M_a, M_g, G, the base's tilt; and its delay, s.
SWEPT = np.repeat([8e-4, 5e-4, 2e-4, 5e-3, 5e-4, 5e-4, 2e-5, 3e-4], [3, 3, 3, 3, 6, 9, 9, 2])
SWEPT_S, MOUNT = 2e-4, exp_se3(np.array([0.02, -0.015, -0.03, 0.3, -0.2, 1.0]))
#: Jumps of the camera's clock, s.
JUMPS_S = (3e-3, 10e-3, -10e-3)
#: How the file may be wrong beyond its covariance: a step of the parameters, and of the delay, s.
WRONG = {
    "": (np.zeros(38), 0.0),
    "mount off by 0.5 deg": (np.append(np.radians([0.5, 0, 0]), np.zeros(35)), 0.0),
    "clock off by 2 ms": (np.zeros(38), 2e-3),
    "scale off by 1 %": (np.isin(np.arange(38), [12, 15, 17, 18, 22, 26]) * 0.01, 0.0),
}


def circles(path: Path) -> Path:
    """Write the quick demo's motions with its circle made four times, and return the file."""
    text = demo._MOTIONS[True].read_text(encoding="utf-8")
    begin = text.index('[[motion]]\nkind = "circle"')
    again = "".join(text[begin:].replace('"circle"\nc', f'"circle {k}"\nc') for k in range(2, 5))
    path.write_text(text + "\n" + again, encoding="utf-8")
    return path


def hidden_run(seed: int, folder: Path) -> tuple[dict[str, tuple[float, float]], list[tuple[float, float]]]:
    """Run a worn arm; return RMS and largest error, mm, of the estimates while the body was hidden, and when that was."""
    found: dict[str, tuple[float, float]] = {}
    spans: list[tuple[float, float]] = []

    def cover(self: Workcell, begin_s: float, end_s: float) -> None:
        for length, circle in HIDDEN:
            start = begin_s + circle * (CIRCLE_S + REST_S)
            spans.append((start, start + length))
            self.source.cover(start, start + length)

    def finish(result: Any, folder: Path, *, truth: Any = None, **_: Any) -> None:
        tracks = Tracks(result.log, result.setup.arm, result.handeye.mounting, result.delay, truth, result.changes)
        part = tracks.between(*result.open_s)
        for name in ("fused", "live"):
            track = getattr(part, name)
            for (begin, end), (length, _) in zip(spans, HIDDEN, strict=True):
                rows = (track.t_s > begin - 0.01) & (track.t_s < end + 0.05)
                metrics = track_metrics(track[rows], part.truth)
                found[f"{name} {length:g} s"] = 1e3 * metrics.position_rms_m, 1e3 * metrics.position_max_m

    demo._MOTIONS = {**demo._MOTIONS, True: circles(folder / "circles.toml")}
    Workcell.cover = cover  # type: ignore[method-assign]
    demo.finish = finish
    demo.run_in = lambda *given, **named: run_in(*given, **named, close_loop=False)
    demo.run_demo(demo.Demo(folder / "run", seed=seed, quick=True))
    return found, spans


def hidden(count: int) -> None:
    """Print the errors while the body was hidden."""
    motions, found = dict(demo._MOTIONS), list[dict[str, tuple[float, float]]]()
    for seed in range(count):
        demo._MOTIONS = motions
        with tempfile.TemporaryDirectory() as folder:
            found.append(hidden_run(seed, Path(folder))[0])
        print(f"seed {seed}: {found[-1]}", file=sys.stderr, flush=True)
    for name in found[0]:
        values = np.array([each[name] for each in found])
        print(
            f"{name:12s} RMS {np.sqrt(np.mean(values[:, 0] ** 2)):.3f} mm (worst arm {values[:, 0].max():.3f}), "
            f"largest: median {np.median(values[:, 1]):.3f}, worst {values[:, 1].max():.3f} mm"
        )


def said_and_read(kind: str, seed: int, truth: dict[str, np.ndarray], folder: Path, wrong: str) -> Path:
    """Write a recording of a unit on the tool, and the file that a calibration would leave; return that."""
    rng, c = np.random.default_rng([seed, 77]), INERTIAL_CLASSES[kind]
    rate_hz = 200.0 if kind == "phone" else 1000.0
    drawn = (c.gyro_noise, c.noise), (c.gyro_bias, c.bias), c.scale, c.g_sensitivity, rng
    errors = InertialErrors.typical(*drawn, good=kind == "icm-42688", rate_hz=rate_hz)
    t_s, z = record(truth["t"], truth["Ts"] @ MOUNT, errors, rng)
    np.savetxt(
        folder / "imu.csv",
        np.column_stack([t_s, z]),
        "%.9g",
        ",",
        header=",".join(["t_s", *COLUMNS[Inertial]]),
        comments="",
    )
    # In the estimator's tool and base: the accelerometer's matrix is upper triangular in axes that are rotated a little.
    R = exp_so3(np.array([errors.scale[5, 1], -errors.scale[5, 0], errors.scale[4, 0]]))
    T = inverse(truth["B"]) @ MOUNT @ pose(R.T, np.zeros(3))
    up = truth["A"][:3, 2]
    M_a, M_g = (np.eye(3) + errors.scale[3:]) @ R.T - np.eye(3), (np.eye(3) + errors.scale[:3]) @ R.T - np.eye(3)
    warm = errors.bias + errors.warming * (1 - np.exp(-25.0 / errors.warming_s))
    G = (errors.g_sensitivity @ R.T).ravel()
    values = np.concatenate([T[:3, 3], warm, M_a[np.triu_indices(3)], M_g.ravel(), G, [-up[1], up[0]]])
    true = replace(Inertial.of("imu", kind, T), values=values)
    step, late_s = WRONG[wrong]
    sensor = true.moved(rng.normal(size=38) * SWEPT + step)
    late_s += np.sqrt(2.0) / (2 * np.pi * errors.bandwidth_hz) + rng.normal() * SWEPT_S
    sensor = replace(sensor, cov=np.diag(SWEPT**2), delay_s=late_s, sigma_delay_s=SWEPT_S)
    file = folder / "references.toml"
    file.write_text(written(Entry(sensor, kind, folder / "imu.csv", None, rate_hz, True), folder))
    return file


def jumps(count: int, first: int) -> None:
    """Print errors and NEES in the two seconds after the camera's clock jumped in motion, without a unit and with."""
    plain, motions = KalmanEstimator.vision, dict(demo._MOTIONS)
    found: dict[tuple[str | None, float], list[Array]] = {}
    for seed in range(first, first + count):
        with tempfile.TemporaryDirectory() as name:
            folder, truth = Path(name), dict[str, np.ndarray]()
            demo._MOTIONS = motions
            demo.true_track = partial(known_truth, truth)
            at_s = hidden_run(seed, folder)[1][0][1] + 1.0
            for kind, by_s in product((None, "icm-42688"), JUMPS_S):

                def vision(
                    self: KalmanEstimator, seen: PoseMeasurement, by_s: float = by_s, at_s: float = at_s
                ) -> Outcome:
                    return plain(self, replace(seen, t_s=seen.t_s + by_s * (seen.t_s > at_s)))

                file = None if kind is None else said_and_read(kind, seed, truth, folder, "")
                with mock.patch.object(KalmanEstimator, "vision", vision):
                    live = replay(Request(str(folder / "run"), references=file), lambda line: None).live
                found.setdefault((kind, by_s), []).append(evaluated(live, truth, [(at_s, at_s + 2.0)])[0])
    for (kind, by_s), rows in found.items():
        each = np.array(rows)
        rms, most, nees = np.sqrt((each[:, 0] ** 2).mean()), each[:, 1].max(), each[:, 2].mean()
        title = f"{kind or 'joints and vision'}, jump by {1e3 * by_s:.0f} ms"
        print(f"{title:36s} RMS {rms:.3f} mm, largest {most:.2f} mm, NEES a freedom {nees:.2f}")


def fused(count: int, first: int) -> None:
    """Print errors of the estimates while the body was hidden, and in motion while it was not, without a unit and with."""
    cases = [None, *((kind, "") for kind in INERTIAL_CLASSES), *(("icm-42688", wrong) for wrong in WRONG if wrong)]
    found: dict[str, list[np.ndarray]] = {}
    motions = dict(demo._MOTIONS)
    for seed in range(first, first + count):
        with tempfile.TemporaryDirectory() as name:
            folder, truth = Path(name), dict[str, np.ndarray]()
            demo._MOTIONS = motions
            demo.true_track = partial(known_truth, truth)
            spans = hidden_run(seed, folder)[1]
            for case in cases:
                file = None if case is None else said_and_read(case[0], seed, truth, folder, case[1])
                live = replay(Request(str(folder / "run"), references=file), lambda line: None).live
                title = "joints and vision" if case is None else f"with {case[0]} {case[1]}"
                found.setdefault(title, []).append(evaluated(live, truth, spans))
        print(f"seed {seed} done", file=sys.stderr, flush=True)
    names = [*(f"{length:g} s hidden" for length, _ in HIDDEN), "seen, moving"]
    for title, rows in found.items():
        each = np.array(rows)
        rms, most, nees = np.sqrt((each[..., 0] ** 2).mean(axis=0)), each[..., 1].max(axis=0), each[..., 2].mean(axis=0)
        for k, name in enumerate(names):
            print(f"{title:36s} {name:14s} RMS {rms[k]:.3f} mm, largest {most[k]:.2f} mm, NEES a freedom {nees[k]:.2f}")


def known_truth(truth: dict[str, np.ndarray], workcell: Workcell, mounting: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the true track, and keep it, the simulated poses, and what lies between the two bases (A) and tools (B)."""
    world, track = workcell.truth, true_track(workcell, mounting)
    A, B = mounting.T_base_rig @ inverse(world.T_base_rig), world.T_tool_body @ inverse(mounting.T_tool_body)
    truth.update(t=track[0], T=track[1], Ts=world.T_base_tool, A=A, B=B)
    return track


def evaluated(live: tuple[Any, ...], truth: dict[str, np.ndarray], spans: list[tuple[float, float]]) -> np.ndarray:
    """Return RMS and largest error of the position, mm, and NEES per freedom, of each hidden span and of what is seen."""
    t = np.array([each.states.t_s[-1] for each in live])
    T, cov = np.array([each.T_base_tool for each in live]), np.array([each.cov for each in live])
    T_true = truth["T"][np.minimum(np.searchsorted(truth["t"], t - 1e-9), len(truth["t"]) - 1)]
    e = log_se3(inverse(T) @ T_true)
    nees, mm = np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov), e) / 6, 1e3 * np.linalg.norm(e[:, :3], axis=1)
    rows = [(t > begin - 0.01) & (t < end + 0.05) for begin, end in spans]
    speed = np.append(0.0, np.linalg.norm(np.diff(T_true[:, :3, 3], axis=0), axis=1) / np.diff(t))
    rows.append((t > spans[0][0] - 4.5) & (speed > 0.02) & ~np.any(rows, axis=0))
    return np.array([(np.sqrt(np.mean(mm[at] ** 2)), mm[at].max(), nees[at].mean()) for at in rows])


def tilt(count: int) -> None:
    """Print errors and sigmas of what gravity shows of worn arms; the sensor warms up, is bent and rounded."""
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for seed in range(3000, 3000 + count):
        arm, rng = worn(seed), np.random.default_rng(seed)
        q, approach = poses(arm.nominal, RESTS, rng, 2.5)
        said = replace(Inertial.of("imu"), cov=np.diag(LEFT**2), sigma_delay_s=0.0)
        true = said.moved(rng.normal(size=38) * np.append(LEFT[:-2], np.radians([0.5, 0.5])))
        readings = []
        for k, T in enumerate(arm.true.forward(arm.joints(q, approach))):
            z = true.expected(ToolMotion(T), ACCELEROMETER).z
            z = z * (1 + 2e-5 * z) + 0.004 * (k / RESTS - 0.5) * np.array([1, -1, 0.5]) + rng.normal(0.0, 0.003, 3)
            readings.append(Reading(float(k), ACCELEROMETER, np.round(z / 0.0024) * 0.0024, 0.004**2 * np.eye(3)))
        beyond = arm.joints(q, approach) - q + 0.5 * arm.backlash * approach
        zeros = (arm.true.offset - arm.nominal.offset) * arm.nominal.direction + beyond.mean(axis=0)
        shown, _ = gravity_shows(arm.nominal, said, q, readings)
        truth = [*true.values[-2:], *(zeros[np.array(each.joints) - 1].sum() for each in shown[2:])]
        for each, value in zip(shown, truth, strict=True):
            rows.setdefault(each.name, []).append((each.value - value, each.sigma, each.open))
    for name, found in rows.items():
        e, sigma, unseen = np.array(found, float).T
        inside = 100 * np.mean(np.abs(e) < 1.96 * sigma)
        rms, said_deg = np.degrees(np.sqrt(np.mean(e**2))), np.degrees(sigma.mean())
        print(
            f"{name:20s} RMS {rms:.3f} deg, sigma {said_deg:.3f}, in 95 %: {inside:.0f} %, open {100 * unseen.mean():.0f} %"
        )


def arm_imu(folder: Path) -> tuple[np.ndarray, np.ndarray, PosePath]:
    """Return times (N,), readings (N, 6) in SI units, and the arm's poses of a recording of the set arm-imu.

    The sensor's samples came late and in bursts: their time is a line through the times of arrival. The arm's quaternions
    are those of the base in the tool.
    """
    from scipy.io import loadmat

    m = loadmat(folder / "MPU9150.mat")
    z = np.hstack([np.radians(m["SENSgyro"].T), STANDARD_GRAVITY_M_S2 * m["SENSacc"].T])
    arrived, count = m["MATLABtime"][0], len(z)
    index = np.arange(count)
    late = index > count // 4
    line = np.polyfit(index[late], arrived[late], 1)
    near = late & (np.abs(arrived - np.polyval(line, index)) < 0.05)
    t = np.polyval(np.polyfit(index[near], arrived[near], 1), index)
    token = m["TokenPosition"][0].astype(int) - 1
    at = m["ABBtime"][0][: len(token)]
    keep = (token >= 0) & (token < count) & np.append(True, np.diff(at) > 0.005)
    Ts = np.tile(np.eye(4), (int(keep.sum()), 1, 1))
    Ts[:, :3, :3] = np.swapaxes(from_quaternion_wxyz(m["ABBquaternion"].T[token[keep]]), 1, 2)
    position = m["ABBposition"].T
    Ts[:, :3, 3] = 1e-3 * (position[token[keep]] if len(position) == count else position[: len(token)][keep])
    good = np.isfinite(z).all(axis=1)
    return t[good], z[good], PosePath(at[keep], Ts)


def rests(folder: Path) -> tuple[list[Reading], list[Reading], Callable[[float], ToolMotion]]:
    """Return means of the accelerometer at rests, means of the gyro in motion, and the arm's motion, of a take of arm-imu.

    Accelerations by the arm's poses, 30 a second, are worse than those at rest by more than their noise says: left out.
    """
    t, z, path = arm_imu(folder)
    motion = cache(path)
    inside = [k for k, at in enumerate(t) if path.covers(float(at), 0.3)]
    t, z = t[inside], z[inside]
    still = np.array([np.abs(motion(float(at)).twist).max() < 2e-3 for at in t])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]]))).reshape(-1, 2)
    resting = [np.arange(a + 15, b - 5) for a, b in edges if b - a > 40]  # without what swings after a motion
    moving = [np.arange(a, a + 20) for a in range(0, len(t) - 20, 20) if not still[a : a + 20].any()]
    z_g, z_w = ([z[rows].mean(axis=0) for rows in each] for each in (resting, moving))
    at_rest = [
        Reading(float(t[r].mean()), ACCELEROMETER, v[3:], 0.01**2 * np.eye(3))
        for r, v in zip(resting, z_g, strict=True)
    ]
    return (
        at_rest,
        [Reading(float(t[r].mean()), GYRO, v[:3], 0.03**2 * np.eye(3)) for r, v in zip(moving, z_w, strict=True)],
        motion,
    )


def gravity() -> None:
    """Print the angle between gravity by sensor and arm at each rest, the sensor calibrated by the other take alone.

    Beside it, by how much the readings themselves differ at the rest of the other take with the same attitude of the arm.
    """
    takes = {folder: rests(folder) for folder in sorted((DATA / "references" / "arm-imu").glob("*/Sequencia*"))}
    found = []
    for folder, (at_rest, _, motion) in takes.items():
        (other,) = (each for each in takes if each.name == folder.name and each != folder)
        known, rates, way = takes[other]
        readings = sorted([*known, *rates], key=lambda reading: reading.t_s)
        first = replace(Inertial.of("imu"), sigma_delay_s=0.0)
        sensor = calibrate(first.begun(readings, way), readings, way).reference
        for reading in at_rest:
            there = motion(reading.t_s)
            e = sensor.expected(there, ACCELEROMETER)
            off, *_ = np.linalg.lstsq(e.by_tool[:, 3:], reading.z - e.z, rcond=1e-6)
            apart = [
                np.linalg.norm(log_se3(inverse(there.T_base_tool) @ way(each.t_s).T_base_tool)[3:]) for each in known
            ]
            alike = known[int(np.argmin(apart))]
            differ = np.linalg.norm(reading.z - alike.z) / STANDARD_GRAVITY_M_S2 if min(apart) < 1e-3 else np.nan
            found.append(np.degrees([np.linalg.norm(off), differ]))
            said = "{:.3f} deg; the readings of both takes differ by {:.3f}".format(*found[-1])
            print(f"{folder.parent.name}/{folder.name} at {reading.t_s:.1f} s: {said}", flush=True)
    off, differ = np.array(found).T
    for name, each in (("all", off), ("readings repeat to 0.2 deg", off[differ < 0.2])):
        print(f"{name}: {len(each)} rests, median {np.median(each):.3f} deg, 90 % {np.quantile(each, 0.9):.3f} deg")


if __name__ == "__main__":
    what, count = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else None
    first = int(sys.argv[3]) if len(sys.argv) > 3 else 4
    if what == "hidden":
        hidden(count or 10)
    elif what == "fused":
        fused(count or 4, first)
    elif what == "jumps":
        jumps(count or 2, first)
    elif what == "tilt":
        tilt(count or 40)
    else:
        gravity()
