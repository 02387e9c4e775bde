"""Skew and readout of two rendered webcams, found from a moving body of discs, and what they do to its pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armsight.data import PoseEstimate, Shot
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.camera.pipeline import SimulatedCamera
from armsight.sim.camera.stages import CameraPipeline
from armsight.sim.example_rig import example_rig
from armsight.sim.render.background import BACKGROUNDS
from armsight.sim.render.render import radiance
from armsight.sim.render.scene import PosedBody
from armsight.sim.workcell.body import body_patterns, body_target
from armsight.vision.pose.measure import measure
from armsight.vision.pose.shutter import LOOSE_PX, Shutters, TimedShot, estimate_shutters, measure_moving
from armsight.vision.rig import StereoRig
from marker_report import Report

SIZE = (1280, 720)
SKEW_S, READOUT_S = 5e-3, 14e-3
SPEEDS, SHOTS, SEEDS, RATE_HZ = (0.3, 0.1, 0.5), 20, 20, 30.0
STEP_S = 1e-3
NOTHING = Shutters(0.0, 0.0, np.zeros((2, 2)))


def recorded(seed: int, speed: float, skew_s: float, readout_s: float) -> tuple[StereoRig, list[TimedShot], np.ndarray]:
    """Render a body on a curve and detect it.

    Args:
        seed: of curve, background and noise.
        speed: RMS speed of the body, m/s; it rotates by twice as many rad/s.
        skew_s: the right camera is later by, s.
        readout_s: of both cameras, s.

    Returns:
        The true rig, the shots that were measured, and the true poses (S, 4, 4) of the shots' time.
    """
    pipeline = CameraPipeline.load("webcam-good-light")
    pipeline = replace(pipeline, timing=replace(pipeline.timing, readout_ms=1e3 * readout_s))
    rng = np.random.default_rng([seed, 1])
    rig, target, patterns = example_rig(SIZE, 900.0), body_target(), body_patterns()
    loose = replace(rig, sigma_px=LOOSE_PX)
    base = pose(exp_so3(rng.normal(0, 0.2, 3)), np.array([0.05, 0.0, 0.8]) + rng.normal(0, 0.02, 3))
    omega, phase = 2 * np.pi * rng.uniform(0.4, 0.8, 6), rng.uniform(0, 2 * np.pi, 6)
    amplitude = speed * np.sqrt(2 / 3) * np.repeat([1.0, 2.0], 3) / omega

    def at(t: float) -> np.ndarray:
        x = amplitude * np.sin(omega * t + phase)
        return pose(base[:3, :3] @ exp_so3(x[3:]), base[:3, 3] + x[:3])

    behind = [BACKGROUNDS["cluttered"](SIZE, rng) for _ in range(2)]
    devices = [SimulatedCamera(pipeline, SIZE, 2 * seed + side) for side in range(2)]
    shots, truth = [], []
    for k in range(SHOTS):
        images = []
        for side, camera in enumerate(rig.cameras):
            t = k / RATE_HZ + side * skew_s
            before, after = (log_se3(inverse(at(t)) @ at(t + h)) for h in (-STEP_S, STEP_S))
            view = PosedBody(patterns, at(t), (after - before) / (2 * STEP_S), (after + before) / STEP_S**2)
            view = view.seen_from(inverse(rig.T_left_right)) if side else view
            light = radiance(
                camera, [view], behind[side], psf_sigma_px=pipeline.psf_sigma_px, shutter=pipeline.shutter(SIZE[1])
            )
            images.append(devices[side].expose(light, t))
        found = measure(loose, target, Shot(str(k), images[0], images[1], k / RATE_HZ))
        if isinstance(found, PoseEstimate):
            shots.append(TimedShot(k / RATE_HZ, found.points.seen, found.T_left_body))
            truth.append(at(k / RATE_HZ))
    return rig, shots, np.array(truth)


def errors_mm(rig: StereoRig, shots: list[TimedShot], truth: np.ndarray, shutters: Shutters) -> np.ndarray:
    """Return the position errors (S, 3) of the shots that were measured, mm."""
    results = measure_moving(rig, body_target().body, shots, shutters)
    pairs = [
        (r.T_left_body, T) for r, T in zip((r for r, _ in results), truth, strict=True) if isinstance(r, PoseEstimate)
    ]
    return np.array([1e3 * (T[:3, 3] - T_true[:3, 3]) for T, T_true in pairs])


def rms(values: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.sum(np.concatenate(values) ** 2, axis=1))))


def section(seed: int, report: Report) -> None:
    body = body_target().body
    for speed in SPEEDS:
        off, z, found, none, together, missed = [], [], [], [], [], 0
        for s in range(seed, seed + SEEDS):
            rig, shots, truth = recorded(s, speed, SKEW_S, READOUT_S)
            rig = replace(rig, sigma_px=0.05)
            shutters = estimate_shutters(rig, body, shots, readout=True)
            if not isinstance(shutters, Shutters):
                report.say(f"  {speed} m/s, seed {s}: {shutters.reason}")
                missed += 1
                continue
            off.append([shutters.skew_s - SKEW_S, shutters.readout_s - READOUT_S])
            z.append(np.array(off[-1]) / shutters.sigmas)
            found.append(errors_mm(rig, shots, truth, shutters))
            none.append(errors_mm(rig, shots, truth, NOTHING))
            if speed == 0.3:
                together.append(errors_mm(rig, *recorded(s, speed, 0.0, 0.0)[1:], NOTHING))
        if not off:
            continue
        worst, by_sigma = 1e3 * np.abs(off).max(axis=0), np.sqrt(np.mean(np.square(z), axis=0))
        each, bias = 1e3 * np.sqrt(np.mean(np.square(off), axis=0)), 1e3 * np.mean(off, axis=0)
        report.say(
            f"  {speed} m/s: {len(off)} found, {missed} not; skew off by {each[0]:.3f} ms RMS, {worst[0]:.3f} at most "
            f"(mean {bias[0]:+.3f}, {by_sigma[0]:.2f} sigma RMS); readout {each[1]:.2f} RMS, {worst[1]:.2f} at most (mean "
            f"{bias[1]:+.2f}, {by_sigma[1]:.2f} sigma)"
        )
        line = f"    position: {rms(found):.3f} mm RMS moved to one time, {rms(none):.3f} as it is"
        report.say(line + (f", {rms(together):.3f} of synchronised global shutters" if together else ""))


if __name__ == "__main__":
    section(3, Report())
