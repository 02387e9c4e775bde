"""Metric 2: reading an image, searching it, fitting a disc, following, a pair to a pose. Medians over cold frames, us."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from armsight.data import Body, Detections, Missed
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.vision.markers.aruco import find_squares
from armsight.vision.markers.tag import Tag, TagTarget
from armsight.vision.pose.measure import measure_detections
from armsight.vision.rig import StereoRig
from disc_images import disc_picture
from disc_surround import TEXTURES
from marker_follow import Following
from marker_peers import FAMILY, aruco, moments, nearest, rms, tag_picture
from marker_plate import LENS, parallel_rig, poses, project, shot, views
from marker_report import Report, disc_target, last_level_cache_bytes, read_us, ring, timed

#: Discs on the images between which the time of one more disc is measured.
COUNTS = (0, 4, 16, 48, 96)
HALF = 20  # of a window about a predicted disc, px


def whole_image(seed: int, report: Report) -> None:
    """Read, search, fit: the time of the search is what an image without discs takes, a disc's what one more adds."""
    rng = np.random.default_rng(seed)
    images = {
        n: [
            disc_picture(
                rng, count=n, radius=(5.0, 15.0), contrast=(80.0, 160.0), blur=0.8, noise=2.0, bright=True
            ).image
            for _ in range(12)
        ]
        for n in COUNTS
    }
    read = read_us(ring(images[4]))
    report.metric("reading an HD image once, cold", read, form=".1f", unit="us")
    target = disc_target()
    medians = []
    for n in COUNTS:
        times, results = timed(target.find, ring(images[n]), 200)
        found = np.mean([len(result.uv) for result in results])
        medians.append(np.median(times))
        report.say(
            f"  {f'find, {n} discs ({found:.1f} found)':62s} {medians[-1]:.1f} us, fastest tenth "
            f"{np.quantile(times, 0.1):.1f}"
        )
    slope, start = np.polyfit(COUNTS, medians, 1)
    read = min(read, read_us(ring(images[4])))
    report.metric(
        "the search of an image without discs, over reading it",
        medians[0] / read,
        "<= 2.0",
        form=".2f",
        good=medians[0] <= 2 * read,
    )
    report.metric(
        "the search as the line over disc counts has it", start / read, "<= 2.0", form=".2f", good=start <= 2 * read
    )
    report.metric("one disc more", slope, "<= 15", form=".1f", unit="us", good=slope <= 15)


def kabsch(p_b: np.ndarray, p_a: np.ndarray) -> np.ndarray:
    """Return T_a_b of matched points (N, 3)."""
    mean_b, mean_a = p_b.mean(axis=0), p_a.mean(axis=0)
    U, _, Vt = np.linalg.svd((p_a - mean_a).T @ (p_b - mean_b))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return pose(R, mean_a - R @ mean_b)


class LibraryRoute:
    """What one would write with OpenCV: a threshold and moments in each window, undistort, triangulate, Kabsch."""

    def __init__(self, rig: StereoRig, points: np.ndarray) -> None:
        self.points = points
        self.K = [camera.matrix for camera in rig.cameras]
        self.d = [camera.distortion for camera in rig.cameras]
        self.P = [np.eye(4)[:3], inverse(rig.T_left_right)[:3]]

    def centres(self, image: np.ndarray, about: np.ndarray) -> np.ndarray:
        out = np.empty((len(about), 1, 2))
        for i, (u, v) in enumerate(about):
            part = image[v - HALF : v + HALF + 1, u - HALF : u + HALF + 1]
            m = cv2.moments(cv2.threshold(part, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[1], True)
            out[i, 0] = u - HALF + m["m10"] / m["m00"], v - HALF + m["m01"] / m["m00"]
        return out

    def __call__(self, case: tuple) -> np.ndarray:
        images, about = case
        xy = [cv2.undistortPoints(self.centres(images[i], about[i]), self.K[i], self.d[i])[:, 0].T for i in (0, 1)]
        p = cv2.triangulatePoints(*self.P, *xy)
        return kabsch(self.points, (p[:3] / p[3]).T)


def accuracy(xi: np.ndarray) -> str:
    """Say the RMS of pose errors (N, 6)."""
    position, rotation = (np.sqrt((part**2).sum(axis=1).mean()) for part in (xi[:, :3], xi[:, 3:]))
    return f"{1e3 * position:.3f} mm, {np.degrees(rotation):.3f} deg RMS"


def pairs(seed: int, report: Report, count: int = 24) -> None:
    """Following four discs, and a pair of images to a pose with covariance."""
    rng = np.random.default_rng(seed)
    rig, target = parallel_rig(LENS, 3.0), disc_target(count=4)
    Ts = poses(rig, target, count, rng, (0.6, 0.9), 25.0)
    images = [shot(rig, target, T, 2.0, rng) for T in Ts]
    about = []
    for T in Ts:
        p = [target.body.points @ at[:3, :3].T + at[:3, 3] for at in views(rig, T)]
        about.append([np.round(project(camera, q)).astype(int) for camera, q in zip(rig.cameras, p, strict=True)])
    repeat = max(2, -(-5 * last_level_cache_bytes() // (4 * images[0][0].nbytes * count)))
    copies = [tuple(image.copy() for image in pair) for _ in range(repeat) for pair in images]
    route = LibraryRoute(rig, target.body.points)
    cases = [(pair, about[i % count]) for i, pair in enumerate(copies)]
    times, results = timed(route, cases, 300)
    xi = np.array([log_se3(inverse(T_hat) @ Ts[i % count]) for i, T_hat in enumerate(results)])
    library = float(np.median(times))
    report.metric("library route, windows known, pair to pose", library, form=".0f", unit="us")
    report.say(f"  {'its error':62s} {accuracy(xi)}")
    times, ways, xi = [], [], []
    for k, T in enumerate(Ts):
        # The same still scene again and again: the first shots find it, the rest follow. Cold copies of the images.
        follow, still = Following(rig, target), copies[k::count]
        for pair in still:
            follow(*pair)
        own, results = timed(lambda pair, follow=follow: (follow(*pair), follow.way), still, 10)
        times += own.tolist()
        ways += [way for _, way in results]
        xi += [log_se3(inverse(r.T_left_body) @ T) for r, _ in results if not isinstance(r, Missed)]
    us, way = np.array(times), np.array(ways)
    report.say(f"  {'shots in still scenes, after the first ones':62s} {dict(Counter(ways))}")
    if not (way == "followed").any():
        return
    ours = float(np.median(us[way == "followed"]))
    report.metric(
        "following four discs, pair to pose with covariance", ours, "<= 200", form=".0f", unit="us", good=ours <= 200
    )
    report.metric("the same over the library route", ours / library, "<= 1", form=".2f", good=ours <= library)
    report.say(f"  {'its error':62s} {accuracy(np.array(xi).reshape(-1, 6))}")


def few_points(seed: int, report: Report, count: int = 60, rounds: int = 12) -> None:
    """Detections to a pose with covariance, of bodies of four, five and nine known points; peers on the same detections."""
    rng, rig = np.random.default_rng(seed), replace(parallel_rig(LENS, 3.0), sigma_px=0.2)
    x, y = np.meshgrid((-0.025, 0.0, 0.025), (-0.025, 0.0, 0.025))
    nine = np.column_stack([x.ravel(), y.ravel(), np.zeros(9)])
    corners = nine[[0, 2, 8, 6]]
    us = {}
    for points in (corners, np.vstack([corners, [[0.0, 0.0, 0.03]]]), nine):
        n = len(points)
        body, seen = Body("body", tuple(f"T.{i}" for i in range(n)), points), []
        for T in poses(rig, disc_target(), count, rng, (0.6, 0.9), 25.0):
            uv = [
                project(camera, points @ at[:3, :3].T + at[:3, 3]) + rig.sigma_px * rng.normal(size=(n, 2))
                for camera, at in zip(rig.cameras, views(rig, T), strict=True)
            ]
            seen.append([Detections(np.arange(n), each, np.zeros((n, 2, 2))) for each in uv])
        ways = (f"{n}", f"{n}, solvePnP", f"{n}, triangulate and Kabsch")
        functions = (
            partial(measure_detections, rig, body),
            partial(one_camera, rig, points),
            partial(rigid, rig, points),
        )
        times = []
        for detections in rounds * seen:
            for function in functions:
                began = time.process_time_ns()
                function(*detections)
                times.append(time.process_time_ns() - began)
        for way, each in zip(ways, np.reshape(times, (-1, 3)).T / 1e3, strict=True):
            us[way] = float(np.median(each))
            report.say(f"  {f'pose of a body, points: {way}':62s} {us[way]:.0f} us, least {each.min():.0f}")
    for n, most_us in ((4, 450), (5, 450), (9, 400)):
        over = us[f"{n}"] / us["9"]
        required, good = f"<= {most_us}, <= 1.3 times nine's", us[f"{n}"] <= most_us and over <= 1.3
        report.metric(f"pose with covariance of {n} points", us[f"{n}"], required, form=".0f", unit="us", good=good)


def one_camera(rig: StereoRig, points: np.ndarray, left: Detections, _: Detections) -> None:
    """Solve for the pose in the left camera."""
    method = cv2.SOLVEPNP_SQPNP if len(points) == 5 else cv2.SOLVEPNP_ITERATIVE
    cv2.solvePnP(points, left.uv, rig.left.matrix, rig.left.distortion, flags=method)


def rigid(rig: StereoRig, points: np.ndarray, left: Detections, right: Detections) -> np.ndarray:
    """Triangulate undistorted points and fit the body to them."""
    xy = [
        cv2.undistortPoints(d.uv[:, None], camera.matrix, camera.distortion)[:, 0].T
        for camera, d in zip(rig.cameras, (left, right), strict=True)
    ]
    p = cv2.triangulatePoints(np.eye(4)[:3], inverse(rig.T_left_right)[:3], *xy)
    return kabsch(points, (p[:3] / p[3]).T)


def textured(seed: int, report: Report, count: int = 4, rounds: int = 7) -> None:
    """Search images of 16 discs before textures, and find contours and moments in the same ones: the least of the times."""
    target = disc_target()
    for kind, amplitude in (("plain", None), *((kind, spread) for spread in (5.0, 18.0) for kind in TEXTURES)):
        rng, sums, found = np.random.default_rng(seed), np.zeros(2), 0
        for _ in range(count):
            kinds = {"kind": kind, "amplitude": amplitude, "bright": True, "noise": 2.0, "blur": 0.8}
            image = disc_picture(rng, count=16, radius=(5.0, 15.0), contrast=(80.0, 160.0), **kinds).image
            dark = 255 - image  # contours are those of dark things
            searched, peer = (timed(f, [i], rounds)[0].min() for f, i in ((target.find, image), (moments, dark)))
            sums += searched, peer
            found += len(target.find(image).uv) / count
        label = kind if amplitude is None else f"{kind}, {amplitude:.0f} levels"
        report.say(
            f"  {f'16 discs, {label} ({found:.1f} found), contours':62s} {sums[0] / count:.0f}, {sums[1] / count:.0f} us"
        )
        over = sums[0] / sums[1]
        report.metric(f"16 discs, {label}: over contours", over, "<= 1.0", form=".2f", good=over <= 1)


def tags(seed: int, report: Report, count: int = 8, rounds: int = 7) -> None:
    """Find and fit AprilTags, and OpenCV's with corners refined, interleaved: least and median of the CPU time."""
    rng, peer = np.random.default_rng(seed), aruco(1.0)  # the window at which its corners are best
    for label, shape, many, most in (
        ("4 tags of 60 px, 1280x720", (720, 1280), 4, 2.0),
        ("4 tags of 60 px, 640x480", (480, 640), 4, 2.0),
        ("16 tags of 60 px, 1280x720", (720, 1280), 16, 2.0),
        ("no tag, 1280x720", (720, 1280), 0, 1.3),
    ):
        ms, corners = [], ([], [])
        while len(ms) < count * rounds:
            image, _, truth = tag_picture(rng, 30.0, many)
            inside = np.all((truth.min(axis=1) > 20) & (truth.max(axis=1) < np.array(shape[::-1]) - 20), axis=1)
            if many and inside.sum() < min(many, 2):
                continue
            image = np.ascontiguousarray(image[: shape[0], : shape[1]])
            ids = [i for i, _ in find_squares(image, FAMILY)] or [0]
            target = TagTarget("b", tuple(Tag(f"T{i}", FAMILY, i, 0.04, np.eye(4)) for i in sorted(set(ids))))
            for _ in range(rounds):
                began = time.process_time_ns()
                own = target.detect(image)
                middle = time.process_time_ns()
                theirs = peer(image)
                ms.append((1e-6 * (middle - began), 1e-6 * (time.process_time_ns() - middle)))
            for kept, uv in zip(corners, (own.uv, theirs.reshape(-1, 2)), strict=True):
                kept.append(nearest(uv, truth.reshape(-1, 2))[0])
        each = np.reshape(ms, (count, rounds, 2))
        least, median = np.median(each.min(axis=1), axis=0), np.median(each, axis=(0, 1))
        px = [rms(np.concatenate(e)) for e in corners]
        for name, k in (("armsight", 0), ("OpenCV", 1)):
            report.say(f"  {label}, {name}: least {least[k]:.2f}, median {median[k]:.2f} ms, {px[k]:.4f} px")
        over = least[0] / least[1]
        report.metric(f"{label}: over OpenCV", over, f"<= {most}", form=".2f", good=over <= most)


def metric(seed: int, report: Report) -> None:
    whole_image(seed, report)
    tags(seed, report)
    textured(seed, report)
    few_points(seed, report)
    pairs(seed, report)
