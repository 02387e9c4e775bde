"""Distance and angle references on real recordings: a draw-wire, ultra-wideband ranges and lighthouse sweeps.

Run: python benchmarks/references_beacons.py DATA [draw-wire] [lighthouse2] [uwb] with DATA the folder of the recordings.
Each line gives the figure, the peer's on the same rows, and the goal.
"""

from __future__ import annotations

import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.optimize import least_squares

from armsight.data import Array
from armsight.errors import InputError
from armsight.estimate.solve import covariances
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3, log_so3
from armsight.loop.identify.fit import linear_of, variances_of, with_joint_noise
from armsight.loop.identify.identify import identify
from armsight.loop.identify.lengths import without_blunders
from armsight.loop.identify.model import motion, nominal_table
from armsight.loop.identify.selection import folds_of
from armsight.loop.references.calibrate import PosePath, calibrate
from armsight.loop.references.distance import Distance, follow_ranges
from armsight.loop.references.lighthouse import Lighthouse, Sweeps, beginning, follow
from armsight.loop.references.reference import Reading
from armsight.robot.arm_file import open_arm

FOLDS = 6


def draw_wire(folder: Path) -> None:
    """Length left out: the identified arm against plain least squares over anchor, tool point and all DH parameters."""
    arm = open_arm("irb120")
    rows = np.loadtxt(folder / "irb120_even.csv", delimiter=",", skiprows=1)
    q, length = np.deg2rad(rows[:, 3:9]), rows[:, 9] * 1e-3
    measured, used, blunders = without_blunders(arm, q, length, rows[:, :3] * 1e-3)
    for lines, text in blunders:
        print(f"  lines {lines.min() + 2} to {lines.max() + 2}: {text}")
    used[used] = identify(
        arm, measured.rows(used)
    ).solution.used  # the peer's outliers, taken out by hand, are the same
    for name, of in (("random", np.random.default_rng(0).integers(0, FOLDS, len(q))), ("clusters", folds_of(q, FOLDS))):
        e, squares, peer = (np.zeros(len(q)) for _ in range(3))
        for k in range(FOLDS):
            train, test = used & (of != k), used & (of == k)
            found, part = identify(arm, measured.rows(train)), measured.rows(test)
            x, free = found.solution.x, found.solution.free
            weighted = with_joint_noise(found.model, x, part, found.joint_sigma_rad)
            linear = linear_of(found.model, x, weighted, free, found.prior)
            cov = covariances(linear, variances_of(linear, found.solution.noise))
            cov = cov + linear.J @ found.solution.cov[np.ix_(free, free)] @ linear.J.swapaxes(1, 2)
            e[test], squares[test] = linear.e[:, 0], linear.e[:, 0] ** 2 / cov[:, 0, 0]
            peer[test] = plain_wire(nominal_table(arm), q, length, train)[test]
        rms, theirs = (1e3 * float(np.sqrt(np.mean(v[used] ** 2))) for v in (e, peer))
        covered = float((squares[used] < 3.84).mean())
        print(
            f"draw-wire, {name} folds, {used.sum()} rows: {rms:.3f} mm, plain least squares {theirs:.3f} mm, ratio "
            f"{rms / theirs:.2f} (goal 0.90); 95 % intervals cover {100 * covered:.1f} %"
        )


def plain_wire(table: Array, q: Array, length: Array, train: Array) -> Array:
    """Return residuals (N,) of plain least squares over anchor, tool point and the 24 DH parameters."""

    def residuals(v: Array) -> Array:
        moved = table.copy()
        moved[:, :4] += v[6:].reshape(6, 4)
        at = motion(moved, q, False, np.eye(3), np.zeros(3))
        return np.asarray(np.linalg.norm(at.o + at.R @ v[3:6] - v[:3], axis=1) - length)

    start = np.concatenate([[0.2, -0.45, 0.0], np.zeros(27)])
    weak = 1e-6  # ties the gauge of parallel axes
    fitted = least_squares(lambda v: np.concatenate([residuals(v)[train], weak * v]), start, x_scale="jac")
    return residuals(fitted.x)


def lighthouse(folder: Path, seconds: float = 60.0) -> None:
    """Held-out takes: bundle of one take gives the beacons, the others are followed with these."""
    moves = folder / "lh2_crossingBeam_move"
    config = yaml.safe_load((moves / "system-config.yaml").read_text())
    beacons = lighthouse_of(config["geos"], config["calibs"])
    for take in range(3):
        events = read_events(moves / f"log{take:02d}")
        sweeps = sweeps_of(events[EVENT], len(beacons.calibration))
        sweeps = sweeps.rows(sweeps.t_s < sweeps.t_s[0] + seconds)
        path = follow(beacons, sweeps, *beginning(beacons, sweeps))
        if take == 0:
            beacons = path.reference
            first_cov = beacons.cov
        mocap = np.load(moves / f"mocap{take:02d}.npy")
        mocap = mocap[~np.isnan(mocap).any(axis=1)]
        seen = [np.sort(sweeps.t_s[sweeps.beacon == b]) for b in (0, 1)]
        clock = clock_between(path.t_s, path.p, mocap[:, 0] * 1e-3, mocap[:, 1:])
        ours = aligned(path.t_s, path.p, path.R, mocap, clock, seen)
        frames, beams = events[EVENT], events["lhCrossingBeam"]
        slope, offset = np.polyfit(frames["t_s"], frames["timestamp2FPGA"] / 24e6, 1)
        at = slope * beams["t_s"] + offset
        inside = at < sweeps.t_s.max()
        crossing = np.column_stack([beams[a][inside] for a in "xyz"])
        theirs = crossing_error(at[inside], crossing, mocap, clock)
        own = path.reference.cov
        spread = np.median(
            np.sqrt(np.einsum("kii->ki", path.covariance(np.arange(40, len(path.t_s) - 40, 80)))), axis=0
        )
        said = "beacons from it" if take == 0 else "held out"
        print(
            f"lighthouse, take {take} ({said}): {1e3 * np.median(ours):.1f} mm, "
            f"{1e3 * np.percentile(ours, 90):.1f} at 90 %, crossing beams {1e3 * np.median(theirs):.1f}, ratio "
            f"{np.median(ours) / np.median(theirs):.2f} (goal 0.33); sweep {1e6 * path.sigma_rad:.0f} urad, "
            f"{100 * path.used.mean():.0f} % used; sigma {1e3 * spread[:3].max():.2f} mm"
        )
        beacons = type(beacons)(
            name="lighthouse",
            cov=0 * own,
            Ts_base_beacon=beacons.Ts_base_beacon,
            calibration=beacons.calibration,
            receivers=beacons.receivers,
        )
    for rest in range(3):
        still = folder / "lh2_crossingBeam_jitter" / f"log{rest:02d}"
        sweeps = sweeps_of(read_events(still)[EVENT], len(beacons.calibration))
        path = follow(beacons, sweeps, *beginning(beacons, sweeps))
        spread = 1e3 * np.linalg.norm(np.std(path.p[40:-40], axis=0))
        print(f"  at rest {rest}: position {spread:.3f} mm (goal 0.1), sweep {1e6 * path.sigma_rad:.0f} urad")
    print(f"  beacons: sigma of poses {np.sqrt(np.diag(first_cov))[:6].round(4)} m, rad")


def uwb(folder: Path) -> None:
    """Position in the plane: the smoother against plain least squares of each ten readings a second.

    Tag's point, delay, offsets and scales come from the other recording, for both; anchors are those of the recording.
    """
    takes = {case: ranges_of(folder / case / "Trajectory_A" / "Case_1") for case in ("LOS", "NLOS")}
    for case, other in zip(takes, reversed(takes), strict=True):
        anchors, t, channel, z, truth = takes[case]
        known = range_sensor(*takes[other])
        sensor = replace(known, anchors=anchors)
        h, at = np.radians(np.unwrap(truth[:, 4], period=360.0)), t - sensor.delay_s

        def tag(at: Array, truth: Array = truth, h: Array = h, p: Array = sensor.p_tool) -> Array:
            heading = np.interp(at, truth[:, 0], h)
            lever = p[0] * np.array([np.cos(heading), np.sin(heading)]) + p[1] * np.array(
                [-np.sin(heading), np.cos(heading)]
            )
            return np.column_stack([np.interp(at, truth[:, 0], truth[:, c]) for c in (1, 2)]) + lever.T

        start = np.append(truth[0, 1:3], anchors[:, 2].mean())
        path = follow_ranges(sensor, t, channel, z, start)
        e = path.p[:, :2] - tag(at)
        squares = np.einsum("ni,nij,nj->n", e, np.linalg.inv(path.cov[:, :2, :2]), e)
        even, right = np.arange(t[0], t[-1], 0.1), (z - sensor.offset[channel]) / sensor.scale[channel]
        each = np.column_stack([np.interp(even, t[channel == c], right[channel == c]) for c in range(4)])
        at_even = tag(even - sensor.delay_s)
        theirs, x = np.empty(len(even)), start
        for k, r in enumerate(each):
            fitted = least_squares(lambda v, r=r, a=anchors: np.linalg.norm(v - a, axis=1) - r, x)
            theirs[k] = np.linalg.norm(fitted.x[:2] - at_even[k])
            x = fitted.x if fitted.cost < 1.0 else x
        ours = np.linalg.norm(e, axis=1)
        rms, rms_plain = (float(np.sqrt(np.mean(v**2))) for v in (ours, theirs))
        print(
            f"uwb, {case}: median {np.median(ours):.2f} m, plain least squares {np.median(theirs):.2f}, ratio "
            f"{np.median(ours) / np.median(theirs):.2f} (goal 0.70); RMS {rms:.2f} m, plain {rms_plain:.2f}; 95 % cover "
            f"{100 * (squares < 5.99).mean():.0f} %; delay {sensor.delay_s:.3f} s, {sensor.sigma_delay_s:.3f}, tag "
            f"{sensor.p_tool.round(2)} m, by {other}"
        )


def ranges_of(folder: Path) -> tuple[Array, Array, NDArray[np.int64], Array, Array]:
    """Return anchors (4, 3), times (N,), channels (N,), ranges (N,) and truth (M, 5): time, position, heading, deg."""
    ranges = [np.loadtxt(path, delimiter=",", skiprows=1) for path in folder.glob("A*.csv")]
    ranges.sort(key=lambda r: tuple(r[0, 3:6]))  # their names are swapped between recordings
    truth = np.loadtxt(folder / "trajectory.csv", delimiter=",", skiprows=1)
    first, t, z = truth[0, 0], np.concatenate([r[:, 1] for r in ranges]), np.concatenate([r[:, 6] for r in ranges])
    channel = np.repeat(np.arange(4), [len(r) for r in ranges])
    order = np.argsort(t)
    order = order[(t[order] > first + 1e9) & (t[order] < truth[-1, 0] - 1e9)]
    truth[:, 0] = (truth[:, 0] - first) * 1e-9
    return np.array([r[0, 3:6] for r in ranges]), (t[order] - first) * 1e-9, channel[order], z[order], truth


def range_sensor(anchors: Array, t: Array, channel: NDArray[np.int64], z: Array, truth: Array) -> Distance:
    """Return ranges calibrated by a path that is known: the tag's point, the delay, each offset and scale."""
    Ts = np.tile(np.eye(4), (len(truth), 1, 1))
    Ts[:, :3, 3], heading = truth[:, 1:4], np.radians(truth[:, 4])
    Ts[:, :3, :3] = exp_so3(np.outer(heading, [0.0, 0.0, 1.0]))
    path = PosePath(truth[:, 0], Ts)
    cov = np.diag(np.append([0.3, 0.3, 1.5], np.tile([0.02, 0.02, 0.02, 0.5, 0.01], 4)) ** 2)
    flat = {"p_tool": np.zeros(3), "offset": np.zeros(4), "scale": np.ones(4), "sigma_delay_s": 0.3}
    readings = [
        Reading(float(t[k]), int(channel[k]), z[k : k + 1], 0.01 * np.eye(1))
        for k in range(0, len(t), 23)
        if path.covers(float(t[k]), 0.8)
    ]
    return calibrate(Distance(name="uwb", cov=cov, anchors=anchors, **flat), readings, path, fit_delay=True).reference


def clock_between(t: Array, p: Array, t_mocap: Array, p_mocap: Array) -> float:
    """Return what is added to motion capture's times, by the correlation of speeds."""
    speed = np.linalg.norm(np.diff(p, axis=0), axis=1) / np.diff(t)
    steps = np.diff(t_mocap)
    theirs = np.linalg.norm(np.diff(p_mocap[::5], axis=0), axis=1) / np.diff(t_mocap[::5])
    at, good = t_mocap[::5][1:] - 0.5 * np.diff(t_mocap[::5]), np.diff(t_mocap[::5]) < 8 * np.median(steps)
    base, best = t[0] - t_mocap[0], (-1.0, 0.0)
    for late in np.arange(-15.0, 15.0, 0.02):
        x = at[good] + base + late
        inside = (x > t[1]) & (x < t[-2])
        if inside.sum() > 500:
            c = np.corrcoef(np.interp(x[inside], t[1:], np.minimum(speed, 4)), np.minimum(theirs[good][inside], 4))[
                0, 1
            ]
            best = max(best, (float(c), float(late)))
    return float(base + best[1])


def aligned(t: Array, p: Array, R: Array, mocap: Array, clock: float, seen: list[Array], near: float = 0.02) -> Array:
    """Return errors (M,), m, where both beacons are seen, after rotation, shift, lever arm and clock have been fitted."""
    at, theirs, dt = mocap[::3, 0] * 1e-3 + clock, mocap[::3, 1:], t[1] - t[0]
    good = (at > t[1]) & (at < t[-3])
    for s in seen:
        j = np.clip(np.searchsorted(s, at), 1, len(s) - 1)
        good &= np.minimum(np.abs(s[j] - at), np.abs(s[j - 1] - at)) < near
    at, theirs = at[good], theirs[good]

    def errors(v: Array) -> Array:
        x = at + v[9]
        k = np.clip(((x - t[0]) / dt).astype(int), 0, len(t) - 2)
        a = ((x - t[k]) / dt)[:, None]
        rotated = R[k] @ exp_so3(a * log_so3(R[k].swapaxes(1, 2) @ R[k + 1]))
        return np.asarray(
            (p[k] * (1 - a) + p[k + 1] * a + rotated @ v[6:9]) @ exp_so3(v[:3].copy()).T + v[3:6] - theirs
        )

    k = np.clip(((at - t[0]) / dt).astype(int), 0, len(t) - 2)
    start = np.concatenate([_shift(p[k], theirs), np.zeros(4)])
    found = least_squares(lambda v: errors(v).ravel(), start, loss="soft_l1", f_scale=0.01, x_scale=0.01)
    return np.asarray(np.linalg.norm(errors(found.x), axis=1))


def _shift(a: Array, b: Array) -> Array:
    """Return rotation vector and shift (6,) from points a to b, by medians."""
    u, _, v = np.linalg.svd((b - np.median(b, axis=0)).T @ (a - np.median(a, axis=0)))
    A = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return np.concatenate([log_so3(A[None])[0], np.median(b, axis=0) - A @ np.median(a, axis=0)])


def crossing_error(t: Array, p: Array, mocap: Array, clock: float) -> Array:
    """Return errors (M,), m, of crossing beams after rotation, shift and clock."""
    at = mocap[:, 0] * 1e-3 + clock
    j = np.clip(np.searchsorted(at, t), 1, len(at) - 1)
    good = np.minimum(np.abs(at[j] - t), np.abs(at[j - 1] - t)) < 0.01

    def errors(v: Array) -> Array:
        theirs = np.column_stack([np.interp(t[good] + v[6], at, mocap[:, c]) for c in (1, 2, 3)])
        return np.asarray(p[good] @ exp_so3(v[:3].copy()).T + v[3:6] - theirs)

    theirs = np.column_stack([np.interp(t[good], at, mocap[:, c]) for c in (1, 2, 3)])
    start = np.append(_shift(p[good], theirs), 0.0)
    found = least_squares(lambda v: errors(v).ravel(), start, loss="soft_l1", f_scale=0.01, x_scale=0.01)
    return np.asarray(np.linalg.norm(errors(found.x), axis=1))


PARTS = {"draw-wire": draw_wire, "lighthouse2": lighthouse, "uwb": uwb}

# Logs of a Crazyflie's lighthouse deck, as its SD card holds them: event types, then events. These give one diode's
# time and, for one of four diodes a sweep, how long ago the beacon began its revolution; the beacon is known only there.
CLOCK_HZ = 24e6  # of the deck
#: Ticks of 48 MHz of a revolution, by channel.
PERIODS = np.array([959, 957, 953, 949, 947, 943, 941, 939, 937, 929, 919, 911, 907, 901, 893, 887]) * 500.0
APART = (
    1200  # ticks between two diodes of one sweep at most; half: sweeps break near a beacon, double: two beacons merge
)
#: (4, 3) diodes of the deck, m.
DIODES = np.array([[-0.015, 0.0075, 0.0], [-0.015, -0.0075, 0.0], [0.015, 0.0075, 0.0], [0.015, -0.0075, 0.0]])
EVENT = "lhUartFrame"
_KEYS = ("phase", "tilt", "curve", "gibmag", "gibphase", "ogeemag", "ogeephase")
#: Sigmas of a beacon's pose as the open tool finds it (m, rad), and of the seven numbers that a beacon sends of a plane.
SIGMA_POSE, SIGMA_SWEEP = (0.3, 0.1), (1e-3, 1e-3, 0.05, 5e-4, 0.5, 0.05, 0.5)


def read_events(path: str | Path) -> dict[str, dict[str, Array]]:
    """Return event name -> variable -> (N,) values; "t_s" is the time stamp.

    Raises:
        InputError: no such log, or it ends early.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}: expected a Crazyflie log") from None
    if len(data) < 9 or data[0] != 0xBC:
        raise InputError(f"{path}: no Crazyflie log: its first byte is not 0xBC")
    version, count = struct.unpack_from("<HH", data, 1)
    if version not in (1, 2):
        raise InputError(f"{path}: version {version} of the log; 1 and 2 are known")
    at, types = 5, {}
    try:
        for _ in range(count):
            (key,) = struct.unpack_from("<H", data, at)
            name, at = _text(data, at + 2)
            (variables,) = struct.unpack_from("<H", data, at)
            at, names = at + 2, []
            for _ in range(variables):
                text, at = _text(data, at)
                names.append(text)
            types[key] = (name, [n[: n.index("(")] for n in names], "<" + "".join(n[n.index("(") + 1] for n in names))
        found: dict[str, list[tuple[float, ...]]] = {name: [] for name, _, _ in types.values()}
        stamp, unit = ("<HI", 1e-3) if version == 1 else ("<HQ", 1e-6)
        while at < len(data) - 4:
            key, t = struct.unpack_from(stamp, data, at)
            name, _, layout = types[key]
            values = struct.unpack_from(layout, data, at + struct.calcsize(stamp))
            found[name].append((t * unit, *values))
            at += struct.calcsize(stamp) + struct.calcsize(layout)
    except (struct.error, KeyError, ValueError) as broken:
        raise InputError(f"{path}: broken at byte {at}: copy the log from the card again") from broken
    keys = {name: ["t_s", *variables] for name, variables, _ in types.values()}
    return {n: dict(zip(keys[n], np.array(rows).reshape(-1, len(keys[n])).T, strict=True)) for n, rows in found.items()}


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(0, at)
    return data[at:end].decode("ascii"), end + 1


def sweeps_of(events: dict[str, Array], beacons: int) -> Sweeps:
    """Return sweeps by the deck's frames; times are the deck's clock, s.

    Args:
        events: variable -> values of EVENT.
        beacons: how many beacons are known; sweeps of others are left out.
    """
    order = np.argsort(events["timestamp2FPGA"], kind="stable")
    ticks, offset = events["timestamp2FPGA"][order], events["offset"][order]
    diode, beacon = events["sensor"][order].astype(int), events["basestation"][order].astype(int)
    out = []
    for rows in np.split(np.arange(len(ticks)), np.flatnonzero(np.diff(ticks) > APART) + 1):
        known = rows[offset[rows] > 0]
        b = np.unique(beacon[known])
        if len(rows) < 2 or len(b) != 1 or b[0] >= beacons or len(np.unique(diode[rows])) < len(rows):
            continue
        period = PERIODS[b[0]]
        plane = int(offset[known[0]] > period / 2)
        rotation = 2 * np.pi * (offset[known[0]] + ticks[rows] - ticks[known[0]]) / period
        out.append((rows, plane, rotation - np.pi + (np.pi / 3 if plane == 0 else -np.pi / 3)))
    if not out:
        raise InputError(f"no sweep of the {beacons} known beacons: does the deck see them?")
    rows = np.concatenate([r for r, _, _ in out])
    first = np.concatenate([np.full(len(r), beacon[r[offset[r] > 0][0]]) for r, _, _ in out])
    planes: NDArray[np.int64] = np.concatenate([np.full(len(r), k) for r, k, _ in out])
    return Sweeps(ticks[rows] / CLOCK_HZ, diode[rows], first, planes, np.concatenate([a for _, _, a in out]))


def lighthouse_of(
    geos: dict[int, dict[str, object]], calibs: dict[int, dict[str, list[dict[str, float]]]]
) -> Lighthouse:
    """Return the beacons of a system configuration's tables ``geos`` and ``calibs``; their order is by number.

    Their poses come from one look at a deck of 30 mm, so that distances are off by per cents: ``cov`` says so.
    """
    keys = sorted(geos)
    Ts = np.stack([pose(np.array(geos[k]["rotation"], float), np.array(geos[k]["origin"], float)) for k in keys])
    calibration = np.array([[[sweep[n] for n in _KEYS] for sweep in calibs[k]["sweeps"]] for k in keys])
    one = np.concatenate([np.repeat(SIGMA_POSE, 3), np.tile(SIGMA_SWEEP, 2)])
    cov = np.diag(np.tile(one**2, len(keys)))
    return Lighthouse(name="lighthouse", cov=cov, Ts_base_beacon=Ts, calibration=calibration, receivers=DIODES)


if __name__ == "__main__":
    for part in sys.argv[2:] or PARTS:
        PARTS[part](Path(sys.argv[1]) / part)
