"""Metric 4: the Motoman arm, its ball of markers, and the laser tracker that watched it."""

from __future__ import annotations

import csv

import numpy as np
from scipy.optimize import least_squares

from armsight.data import Missed
from armsight.errors import ArmsightError
from armsight.geometry.pose import exp_se3, mean_pose, transform
from armsight.geometry.rigid import fit_rigid, fit_scale
from armsight.geometry.rotation import log_so3
from armsight.vision.calibrate.bodies import calibrate_bodies
from armsight.vision.camera_file import read_cameras
from armsight.vision.detections import read_detections
from armsight.vision.markers.body_file import load_body_csv
from armsight.vision.match import gate
from armsight.vision.pose.assign import candidates, instances
from armsight.vision.pose.locate import locate
from armsight.vision.pose.measure import measure_seen
from armsight.vision.triangulate import triangulate
from real_sets import DATA

FOLDER = DATA / "arm" / "motoman"


def read(name: str):
    folder = FOLDER / name
    body = load_body_csv(folder / "markers.csv")
    with open(folder / "tracker.csv", encoding="utf-8") as file:
        seen = {r["shot"]: np.array([float(r[k]) for k in ("x_m", "y_m", "z_m")]) for r in csv.DictReader(file)}
    return body, read_detections(folder / "detections.csv", body), read_cameras(folder / "cameras.json"), seen


def common(shot) -> int:
    return len(np.intersect1d(*shot.ids))


def scatter_deg(Ts) -> float:
    R = mean_pose(np.stack(Ts))[:3, :3]
    return float(np.degrees(np.sqrt(np.mean([np.sum(log_so3(R.T @ T[:3, :3]) ** 2) for T in Ts]))))


def off_mm(T_tracker_left, reflector, Ts, p):
    """Distances, mm, of the reflector as seen by the cameras from where the tracker saw it."""
    return 1e3 * np.array(
        [np.linalg.norm(transform(T_tracker_left, transform(t, reflector)) - q) for t, q in zip(Ts, p, strict=True)]
    )


def spread(e) -> str:
    return f"mean {e.mean():.3f} mm, RMS {np.sqrt((e**2).mean()):.3f}, max {e.max():.2f}"


def tracker() -> None:
    print("\n4. Motoman right_hand_6x6x6: even shots fitted and registered to the tracker, odd ones of the 43 measured")
    print(
        "  (where the reflector sits on the body is not known. The arm holds the orientation, so its position follows "
        "from the scatter of the measured orientations alone; it leans towards the point of the body that is measured best)"
    )
    body, shots, cameras, truth = read("right_hand_6x6x6")
    measurable = [s for s in shots if common(s) >= 3]
    for label, train in (
        ("even of the 43", [s for s in measurable if int(s.name) % 2 == 0]),
        ("all even shots", [s for s in shots if int(s.name) % 2 == 0]),
    ):
        for refine in (False, True):
            c = calibrate_bodies(body, train, cameras, refine_body=refine)
            results = {s.name: measure_seen(c.rig, c.body, s) for s in measurable}
            missed = [name for name, r in results.items() if isinstance(r, Missed)]
            Ts = {name: r.T_left_body for name, r in results.items() if not isinstance(r, Missed)}
            even, odd = ([n for n in Ts if int(n) % 2 == k] for k in (0, 1))
            # tracker.csv is a reflector somewhere on the end-effector; taking it for the body's origin is the other way.
            seen, tracked = [Ts[n] for n in even], np.array([truth[n] for n in even])
            T, reflector = register(seen, tracked)
            e = off_mm(T, reflector, [Ts[n] for n in odd], [truth[n] for n in odd])
            at_origin = fit_rigid(np.array([t[:3, 3] for t in seen]), tracked)
            e_origin = off_mm(at_origin, np.zeros(3), [Ts[n] for n in odd], [truth[n] for n in odd])
            tips, offset_mm = np.array([transform(t, reflector) for t in Ts.values()]), 1e3 * np.linalg.norm(reflector)
            scale = fit_scale(np.array([truth[n] for n in Ts]), tips)
            predicted = [np.degrees(np.sqrt(np.trace(results[n].cov[3:, 3:]))) for n in odd]
            print(
                f"  {label}, {'refined' if refine else 'nominal'} body: {len(odd)} odd shots measured, missed "
                f"{missed or 'none'}; reflector's position on the body fitted on even shots (found {offset_mm:.0f} mm "
                f"from the origin): {spread(e)}; reflector taken for the body's origin: {spread(e_origin)}; "
                f"orientation scatter {scatter_deg([Ts[n] for n in odd]):.3f} deg RMS (predicted "
                f"{np.sqrt(np.mean(np.square(predicted))):.3f}); "
                f"scale against the tracker {100 * (scale - 1):+.2f}%; epipolar {c.epipolar_rms_px:.2f} px; "
                f"{'; '.join(c.notes)}"
            )
    for name in ("self_lower1_4x4", "self_lower2_4x4", "self_upper1_4x4", "self_upper2_4x4"):
        two_arms(name)
    for name in ("rep_self1", "rep_self2"):
        repeatability(name)


def bodies_in(shot, body, rig):
    """Every ball in a shot, located, the left one in the image first."""
    found = candidates(body.points, rig.cameras, shot)
    located = []
    for _, seen in instances(body.points, rig, shot, found):
        result = locate(rig, body, triangulate(rig, body, gate(rig, body, seen)))
        if not isinstance(result, Missed):
            located.append(result)
    return sorted(located, key=lambda r: r.T_left_body[0, 3])


def register(Ts, p):
    """Tracker pose and reflector position that fit best: p ~ T (R reflector + t)."""
    start = fit_rigid(np.array([T[:3, 3] for T in Ts]), p)

    def predicted(x):
        reflector = np.array([T[:3, :3] @ x[6:] + T[:3, 3] for T in Ts])
        return transform(start @ exp_se3(x[:6]), reflector)

    x = least_squares(lambda x: np.r_[(predicted(x) - p).ravel() / 1e-3, x[6:] / 0.3], np.zeros(9)).x
    return start @ exp_se3(x[:6]), x[6:]


def two_arms(name: str) -> None:
    body, shots, cameras, truth = read(name)
    even, odd = shots[1::2], shots[::2]
    try:
        c = calibrate_bodies(body, even, cameras)
    except ArmsightError as error:
        print(f"  {name}: not calibrated: {error}")
        return
    out = []
    for which in (0, -1):
        fits = {s.name: b[which] for s in shots if len(b := bodies_in(s, c.body, c.rig)) >= 2}
        names = [[s.name for s in part if s.name in fits] for part in (even, odd)]
        if min(map(len, names)) < 4:
            continue
        T, reflector = register([fits[n].T_left_body for n in names[0]], np.array([truth[n] for n in names[0]]))
        tips = {n: fits[n].T_left_body[:3, :3] @ reflector + fits[n].T_left_body[:3, 3] for n in names[1]}
        e = [1e3 * np.linalg.norm(transform(T, tips[n]) - truth[n]) for n in names[1]]
        out.append(f"{('left', 'right')[which]} ball {np.mean(e):.2f} mm mean over {len(e)} odd shots")
    print(f"  {name} (two balls in view): epipolar {c.epipolar_rms_px:.2f} px; against the tracker: {'; '.join(out)}")


def repeatability(name: str) -> None:
    _, calibration_shots, cameras, _ = read("self_upper1_4x4")
    body, shots, _, truth = read(name)
    c = calibrate_bodies(body, calibration_shots, cameras)
    out = []
    for which in (0, -1):
        Ts = [b[which].T_left_body for s in shots if len(b := bodies_in(s, c.body, c.rig)) >= 2]
        if len(Ts) < 3:
            continue
        p = np.array([T[:3, 3] for T in Ts])
        rms = 1e3 * np.sqrt(((p - p.mean(axis=0)) ** 2).sum(axis=1).mean())
        out.append(f"{('left', 'right')[which]} ball {rms:.3f} mm, {scatter_deg(Ts):.3f} deg over {len(Ts)} shots")
    p = np.array(list(truth.values()))
    said = 1e3 * np.sqrt(((p - p.mean(axis=0)) ** 2).sum(axis=1).mean())
    print(f"  {name}, repeatability RMS: {'; '.join(out)} (tracker {said:.3f} mm; rig from self_upper1_4x4)")
