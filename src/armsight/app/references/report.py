"""What the recordings of references are like, and what a calibration or gravity shows, as reports.

In: entries of references.toml, and tables of poses or joints. Out: a report, and the entries as calibrated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from armsight.app.show.messages import Note
from armsight.app.show.report import Fact, Grade, Report
from armsight.app.show.table import TextTable
from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.rotation import log_so3
from armsight.loop.identify.gravity import check_rests, gravity_shows
from armsight.loop.references.calibrate import PosePath, ReferenceCalibration
from armsight.loop.references.calibrate import calibrate as fit
from armsight.loop.references.distance import MOST_M, Distance
from armsight.loop.references.file import COLUMNS, Entry, Sensor, read_recording
from armsight.loop.references.heading import AVERAGED_S, FIELDS_S, Magnetometer, check_unit
from armsight.loop.references.inertial import ACCELEROMETER, INERTIAL_CLASSES, Inertial
from armsight.loop.references.reference import STANDARD_GRAVITY_M_S2, Reading, ToolMotion
from armsight.loop.references.stream import StreamCheck, allan, check_stream, coefficients, settling
from armsight.robot.arm_file import open_arm
from armsight.tables.poses import read_pose_table

#: A noise so many times that of its class is said.
NOISY = 3.0
#: The rate may differ by this share from what the file says.
RATE = 0.05
#: Gravity at rest may be off by this share.
UNIT = 0.2
#: A rest is so long at least, s.
REST_S = 0.5
#: A smaller sweep is said to be small, deg; half: levers off by 10 mm pass, double: good sweeps are blamed.
SMALL_DEG = 60.0
#: Stamps of a sensor may be so late against those of the poses, s; half: a phone's are not found, double: more is cut off.
DELAY_S = 0.5
#: Errors left out over their sigma up to which it is good; half: chance is a fault, double: looseness is none.
HONEST = 1.5
#: What is said of others at rest, unit and its scale, and what drifts by more: a field, T, by 3 degrees of heading in
#: Europe, a range, m; half, double: so much of it.
RESTS = {"field": ("uT", 1e6, 1e-6, "motors near"), "range": ("mm", 1e3, 5e-4, "a wire that slips")}
#: Times that are off are so many at most in a line.
SPELLS = 5
#: Readings that are off by less than this share with another's anchor are its; half: swapped anchors that are near pass.
SWAPPED = 0.3
#: Units of the Allan deviation's coefficients, in keys of JSON.
ALLAN = {
    "gyro": ("rad", "rad_per_sqrt_s", "rad_s", "rad_s_per_sqrt_s", "rad_s2"),
    "accelerometer": ("m_s", "m_s_per_sqrt_s", "m_s2", "m_s2_per_sqrt_s", "m_s3"),
}
#: Channels: their unit, and the least noise of a mean in it, below any chip's; half, double: nothing.
CHANNELS = {"gyro": ("rad/s", 1e-6), "accelerometer": ("m/s2", 1e-6), "field": ("T", 1e-8), "range": ("m", 1e-6)}


def gravity_report(entry: Entry, model: str, joints: Path) -> Report:
    """Return the base's tilt and the joint zeros that gravity shows; an InputError names what it cannot use."""
    if not isinstance(unit := entry.reference, Inertial):
        raise InputError(f"{entry.where}: is no inertial unit, which alone feels gravity")
    arm = open_arm(model)
    table = read_pose_table(joints, arm=arm, only_joints=True)
    if table.t_s is None or table.q is None:
        raise InputError(f"{joints}: line 1: a column t_s is needed")
    check_rests(str(joints), len(table.q))  # before the recording, which may take long
    source, t_s, z = _recording(entry)
    readings = []
    for rest, at in enumerate(table.t_s + unit.delay_s):
        rows = np.flatnonzero(np.abs(t_s - at) <= REST_S / 2)
        if len(rows) < 8:
            raise InputError(
                f"{source}: {len(rows)} readings within {REST_S / 2:g} s of the rest at {at:.3f} s; do both have one clock?"
            )
        parts = [z[part, 3:].mean(axis=0) for part in np.array_split(rows, 4)]
        noise = np.maximum(np.var(parts, axis=0, ddof=1) / 4, 1e-6)
        readings.append(Reading(float(rest), ACCELEROMETER, np.mean(parts, axis=0), np.diag(np.full(3, noise.mean()))))
    sensor, poses = replace(unit, delay_s=0.0), arm.forward(table.q)  # from here on a rest's time is its row
    if not entry.calibrated:
        sensor = sensor.begun(readings, lambda rest: ToolMotion(poses[int(rest)]))
    shown, found = gravity_shows(arm, sensor, table.q, readings)
    values = {
        "name": sensor.name,
        "rests": len(readings),
        "outliers": int((~found.used).sum()),
        "found": [
            {"name": e.name, "joints": list(e.joints), "value_rad": e.value, "sigma_rad": e.sigma, "open": e.open}
            for e in shown
        ],
    }
    cells = tuple(
        (each.name, "open" if each.open else f"{np.degrees(each.value):.3f}", f"{np.degrees(each.sigma):.3f}")
        for each in shown
    )
    blocks = [
        TextTable(f"{sensor.name}: {len(readings)} rests, {values['outliers']} outliers", ("", "deg", "sigma"), cells)
    ]
    closed = [each for each in shown if not each.open]
    worst = np.degrees(max(each.sigma for each in shown[:2]))
    said = f"the base's tilt is known to {worst:.3f} deg, and {len(closed) - 2} zeros or sums; the others are open"
    answer: tuple[Grade, str] = ("good", f"Good: {said}.")
    if len(closed) < 3:
        answer = "fair", f"Usable for the tilt alone: {said}; more rests, about other joints, show more."
    sections = {"gravity": ("Gravity", blocks)}
    return Report("references gravity", "Gravity", "", "", sections, (), values, assessed=answer)


def _recording(entry: Entry) -> tuple[Path, Array, Array]:
    """Return the file of a reference, its times (N,) and its values (N, m)."""
    if entry.source is None:
        raise InputError(f'{entry.where}: no source; name its recording: source = "imu.csv"')
    return entry.source, *read_recording(entry.source, type(entry.reference))


def checked(entries: list[Entry]) -> Report:
    """Return what the recordings are like."""
    notes, facts, found = list[Note](), list[Fact](), list[dict[str, Any]]()
    for entry in entries:
        values, lines, weak = _check(entry)
        found.append(values)
        notes += [Note("weak", text) for text in weak]
        facts += [Fact(line) for line in lines]
    name = "references check"
    sections = {"references": ("References", facts)}
    like = "what was recorded is as its class is"
    if not all(isinstance(entry.reference, Inertial) for entry in entries):
        like = "nothing is wrong with what was recorded"
    done = all(entry.calibrated for entry in entries)
    further = "run, demo and replay --references take the file" if done else "references calibrate is next"
    answer: tuple[Grade, str] = ("good", f"Good: {like}; {further}.")
    if notes:
        answer = "fair", f"Usable with care: {notes[0].text}."
    return Report(name, "References", "", "", sections, notes, {"references": found}, assessed=answer)


def _weak_stream(entry: Entry, stream: StreamCheck, axes: list[str], t_s: Array, z: Array) -> list[str]:
    """Return what is weak in how readings came, whatever they are."""
    name, weak = entry.reference.name, []
    if entry.rate_hz is not None and abs(stream.rate_hz / entry.rate_hz - 1) > RATE:
        weak.append(f"{name}: the rate is {stream.rate_hz:.4g} Hz, not {entry.rate_hz:g} as the file says")
    if stream.gaps:
        after_s = t_s[np.diff(t_s).argmax()]
        gap = f"no reading for {stream.longest_gap_s:.2g} s after {after_s:.3f} s"
        weak.append(f"{name}: {gap} (gaps: {stream.gaps}): readings were lost, or its clock jumped")
    if len(COLUMNS[type(entry.reference)]) > 1:  # one number repeats where its step is above the noise
        if stream.doubled > RATE:
            weak.append(f"{name}: {100 * stream.doubled:.0f} % of readings repeat the one before: it is read too often")
        if stream.frozen_s:
            weak.append(f"{name}: no value changes for {stream.frozen_s:.2f} s")
        still = [axis for axis, column in zip(axes, z.T, strict=True) if np.ptp(column) == 0.0]
        weak += [f"{name}: {axis} never changes: it is not read, or broken" for axis in still]
    return weak + [f"{name}: {axes[k]} stands at the end of its range: that is too small" for k in stream.saturated]


def _check(entry: Entry) -> tuple[dict[str, Any], list[str], list[str]]:
    source, t_s, z = _recording(entry)
    name, stream = entry.reference.name, check_stream(t_s, z, str(source))
    kept = ("rate_hz", "jitter_s", "gaps", "longest_gap_s", "doubled", "frozen_s")
    values: dict[str, Any] = {"name": name, "readings": len(t_s)} | {each: getattr(stream, each) for each in kept}
    axes = ["_".join(column.split("_")[:2]) for column in COLUMNS[type(entry.reference)]]
    values["saturated"] = [axes[k] for k in stream.saturated]
    lines = [
        f"{name}: {len(t_s)} readings, {stream.rate_hz:.4g} Hz, jitter {round(1e3 * stream.jitter_s, 4):.2g} ms, "
        f"{stream.gaps} gaps, the longest {1e3 * stream.longest_gap_s:.0f} ms"
    ]
    for unit, scale in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if entry.rate_hz is not None and abs(stream.rate_hz * scale / entry.rate_hz - 1) <= RATE:
            raise InputError(f"{source}: the rate is {stream.rate_hz:.4g} Hz, as if t_s were in {unit}; give s")
    weak = _weak_stream(entry, stream, axes, t_s, z)
    if isinstance(entry.reference, Magnetometer):
        check_unit(str(source), z)
    if isinstance(entry.reference, Distance) and not np.median(np.abs(z)) < MOST_M:
        raise InputError(f"{source}: ranges are {np.median(np.abs(z)):.3g}, as if in mm; give m")
    rest = z[stream.rest]
    values["rest_s"] = len(rest) / stream.rate_hz
    if not len(rest):
        weak.append(f"{name}: never at rest for a second: its noise is not determined")
        return values, lines, weak
    if not isinstance(entry.reference, Inertial):
        _, variance, _ = allan(rest, 1.0 / stream.rate_hz)  # of single readings: without what drifts
        drifts = np.abs(rest[-len(rest) // 4 :].mean(axis=0) - rest[: len(rest) // 4].mean(axis=0))
        noise, (channel,) = np.sqrt(variance[0]), entry.reference.channels
        (unit, scale, most, why), key = RESTS[channel], CHANNELS[channel][0].lower()
        if channel == "range" and (ratio := float(noise[0]) / entry.noise_m) > NOISY:
            weak.append(
                f"{name}: never at rest, or its noise, {1e3 * noise[0]:.2g} mm, is {ratio:.2g} times noise_m: "
                "correct noise_m or the unit"
            )
            return values | {"rest_s": 0.0}, lines, weak
        values |= {f"noise_{key}": noise, f"drift_{key}": drifts}
        drifted = f"{scale * drifts.max():.2g} {unit} at rest"
        lines.append(f"{name}: noise {scale * noise.max():.2g} {unit}, drift {drifted} for {values['rest_s']:.1f} s")
        chance = NOISY * noise * np.sqrt(8.0 / len(rest))  # of two means of a quarter each
        if (drifts > np.maximum(most, chance)).any():
            weak.append(f"{name}: it drifts by {drifted}: {why}, or it warms up")
        return values, lines, weak
    force = float(np.linalg.norm(rest[:, 3:].mean(axis=0)))
    if abs(force - 1.0) < UNIT:
        raise InputError(f"{source}: the accelerometer reads {force:.3g} at rest, as if in g; give m/s2")
    if abs(force / STANDARD_GRAVITY_M_S2 - 1.0) > UNIT:
        weak.append(f"{name}: gravity is {force:.3g} m/s2 at rest")
    values["gravity_m_s2"] = force
    settled = settling(t_s, z[:, 3:], stream.rests)
    values["settling"] = None if settled is None else settled._asdict()
    if settled is not None:
        lines.append(
            f"{name}: after {settled.stops} stops the tool vibrates by {1e3 * settled.amplitude_m:.2g} mm at "
            f"{settled.frequency_hz:.3g} Hz, damped by {settled.damping:.2g} of critical, and settles in "
            f"{settled.time_s:.2f} s"
        )
    noise, said, noisy = _noise(entry, rest, stream.rate_hz)
    return values | noise, lines + said, weak + noisy


def _noise(entry: Entry, rest: Array, rate_hz: float) -> tuple[dict[str, Any], list[str], list[str]]:
    """Return the noise of an inertial unit that rests, readings (N, 6), beside that of its class."""
    name, values, lines, weak = entry.reference.name, dict[str, Any](), list[str](), list[str]()
    tau, variance, freedom = allan(rest, 1.0 / rate_hz)
    c = INERTIAL_CLASSES[entry.sensor_class]
    for sensor, rows, usual, unit in (
        ("gyro", slice(0, 3), c.gyro_noise, "rad/s"),
        ("accelerometer", slice(3, 6), c.noise, "m/s2"),
    ):
        each = [coefficients(tau, column, freedom) for column in variance[:, rows].T]
        units = dict(zip(each[0], ALLAN[sensor], strict=True))
        values[sensor] = {f"{key}_{units[key]}": [one[key] for one in each] for key in units}
        density = float(np.sqrt(np.mean([one["random_walk"] ** 2 for one in each])))
        ratio = density / usual
        values[sensor]["noise_over_class"] = ratio
        lines.append(
            f"{name}: {sensor} noise {density:.3g} {unit}/sqrt(Hz) at rest for {len(rest) / rate_hz:.1f} s, {ratio:.2g} "
            f"times that of {entry.sensor_class}"
        )
        if ratio > NOISY:
            weak.append(
                f"{name}: {sensor} is {ratio:.2g} times as noisy as {entry.sensor_class}: motors near, or its unit"
            )
    return values, lines, weak


def calibrated(entries: list[Entry], poses: Path) -> tuple[Report, list[Entry]]:
    """Return what poses show of each reference, and the entries as calibrated; an InputError names what it cannot use."""
    table = read_pose_table(poses, side="tool")
    if table.t_s is None:
        raise InputError(f"{poses}: line 1: a column t_s is needed")
    path = PosePath(table.t_s, table.Ts)
    found, blocks, done = list[dict[str, Any]](), list[Fact | TextTable](), list[Entry]()
    notes = [Note("note", text) for text in table.notes]
    R = table.Ts[:, :3, :3]
    far = int(np.argmax(np.linalg.norm(log_so3(R[0].T @ R), axis=1)))  # from the first pose; and from there
    angle_deg = float(np.degrees(np.linalg.norm(log_so3(R[far].T @ R), axis=1).max()))
    if angle_deg < SMALL_DEG:
        lost = {Inertial: "lever", Magnetometer: "iron", Distance: "tool's point"}
        what = " and ".join(f"the {lost[type(each.reference)]} of {each.reference.name}" for each in entries)
        text = f"{poses}: the tool rotates by {angle_deg:.0f} deg: {what} may be off by more than sigma"
        notes.append(Note("weak", f"{text}; rotate it by {SMALL_DEG:.0f} deg and more, about two axes"))
    for entry in entries:
        readings = _averaged(entry, path)
        click.echo(f"{entry.reference.name}: fitting its parameters to {len(readings)} readings", err=True)
        _require_own(entry, entries, readings, path)
        began = entry.reference if entry.calibrated else entry.reference.begun(readings, path)
        result = fit(began, readings, path, fit_delay=True)
        noise = max(result.noise.values()) * float(np.sqrt(np.median([each.cov[0, 0] for each in readings])))
        done.append(replace(entry, reference=result.reference, calibrated=True, noise_m=noise))
        values, parts = _said(result)
        if isinstance(entry.reference, Distance):
            off = [readings[k].t_s for k in np.flatnonzero(~result.used)]
            notes += [Note("weak", f"{entry.where}: {text}") for text in _ranges_off(off, noise, values)]
        found.append(values)
        blocks += parts
    sections = {"references": ("References", blocks)}
    worst = max(found, key=lambda each: each["left_out_over_sigma"])
    ratio = f"{worst['name']}: times left out are off by {worst['left_out_over_sigma']:.2f} of their sigma"
    answer: tuple[Grade, str] = ("good", f"Good: {ratio}; run, demo and replay --references take the file.")
    if worst["left_out_over_sigma"] > HONEST:
        answer = "fair", f"Usable with care: {ratio}: something moves that no parameter describes; fasten the sensor."
    values = {"references": found}
    return Report("references calibrate", "References", "", "", sections, notes, values, assessed=answer), done


def _require_own(entry: Entry, entries: list[Entry], readings: list[Reading], path: PosePath) -> None:
    """Raise an InputError where a range's readings fit the anchor of another one."""
    if not (isinstance(entry.reference, Distance) and entry.calibrated):
        return
    fits = {
        other.where: np.median([abs(float(z.z[0] - other.reference.expected(path(z.t_s), 0).z[0])) for z in readings])
        for other in entries
        if isinstance(other.reference, Distance) and other.calibrated
    }
    best = min(fits, key=lambda where: fits[where])
    if fits[best] < SWAPPED * fits[entry.where]:
        raise InputError(f"{entry.where}: its readings fit the anchor of {best}: swap their sources")


def _ranges_off(off_s: list[float], noise_m: float, values: dict[str, Any]) -> Iterator[str]:
    """Yield what is weak about a range: when it was off, times in s, and that its noise, m, is large."""
    if off_s:
        spells = np.split(off_s, np.flatnonzero(np.diff(off_s) > DELAY_S) + 1)
        times = ", ".join(f"{each[0]:.1f} to {each[-1]:.1f}" for each in spells[:SPELLS])
        yield f"ranges are off at {times} s: a wire that hooks, a thing between?"
    if (most := values["noise_factor"]["range"]) > NOISY:
        said = f"it is off by {1e3 * noise_m:.2g} mm, {most:.2g} times its noise"
        yield f"{said}: a wire that hangs through, or poses that are off"


def _averaged(entry: Entry, path: PosePath) -> list[Reading]:
    """Return readings of both channels, means of a short time each, with the covariance that their spread gives."""
    source, t_s, z = _recording(entry)
    size = max(round(AVERAGED_S * check_stream(t_s, z, str(source)).rate_hz), 1)
    count = len(t_s) // size
    times = t_s[: count * size].reshape(count, size).mean(axis=1)
    channels = len(entry.reference.channels)
    means = z[: count * size].reshape(count, size, channels, -1).mean(axis=1)
    within = np.flatnonzero([path.covers(t - entry.reference.delay_s, DELAY_S) for t in times])
    if len(within) < 20:
        raise InputError(
            f"{source}: {len(within)} times of {AVERAGED_S:g} s lie within the poses; do both have one clock?"
        )
    # Of neighbouring means what is not a line in time is noise; its median is that of rests, too, where there are any.
    bend = means[2:] - 2 * means[1:-1] + means[:-2]
    least = np.array([[CHANNELS[name][1]] for name in entry.reference.channels])
    noise = np.maximum(np.median(np.abs(bend), axis=0) / (0.6745 * np.sqrt(6.0)), least)
    return [
        Reading(float(times[k]), channel, means[k, channel], np.diag(noise[channel] ** 2))
        for k in within[:: 1 if channels > 1 else max(round(FIELDS_S / float(np.median(np.diff(times)))), 1)]
        for channel in range(channels)
    ]


def _said(result: ReferenceCalibration[Sensor]) -> tuple[dict[str, Any], list[Any]]:
    sensor, sigmas = result.reference, np.sqrt(np.diag(result.reference.cov))
    named = dict(zip(sensor.parameters, sigmas.tolist(), strict=True))
    count = len(sensor.channels)
    errors = {
        name: float(np.sqrt(np.mean(result.left_out[k::count][result.used[k::count]] ** 2)))
        for k, name in enumerate(sensor.channels)
    }
    values = {
        "name": sensor.name,
        "parameters": sensor.parameters,
        "sigma": named,
        "delay_s": sensor.delay_s,
        "sigma_delay_s": sensor.sigma_delay_s,
        "open": list(result.open),
        "noise_factor": result.noise,
        "left_out_rms": {f"{name}_{CHANNELS[name][0].lower().replace('/', '_')}": rms for name, rms in errors.items()},
        "left_out_over_sigma": float(np.sqrt(np.mean(result.squares[result.used]))),
        "outliers": int((~result.used).sum()),
    }
    rows = tuple(
        (name, "open" if name in result.open else f"{value:.5g}", f"{named[name]:.2g}")
        for name, value in (*sensor.parameters.items(),)
    )
    delay = ("delay_s", f"{sensor.delay_s:.5g}", f"{sensor.sigma_delay_s:.2g}")
    wrong = " and ".join(f"{rms:.3g} {CHANNELS[name][0]}" for name, rms in errors.items())
    sentence = (
        f"{sensor.name}: readings of times left out are wrong by {wrong} RMS, {values['left_out_over_sigma']:.2f} sigma; "
        f"{values['outliers']} of {len(result.used)} are outliers"
    )
    return values, [Fact(sentence), TextTable(sensor.name, ("parameter", "value", "sigma"), (*rows, delay))]
