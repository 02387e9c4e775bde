"""Metric 5: following the plate along a path with occlusions, and the one file that knows how armsight follows."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from armsight.data import Missed, PoseEstimate, Shot
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.follow.follower import Follower
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.rig import StereoRig
from disc_images import exposed
from marker_plate import BLUR, LENS, cover_up, ellipses, in_view, light_of, parallel_rig, views
from marker_report import Report, disc_target, opened, without_numbers

RATE_HZ, SPEED, NOISE = 60.0, 0.5, 2.0
#: A pose is wrong where its squared distance from truth in sigmas is beyond chance, or it is rotated by so much.
WRONG_QUANTILE, WRONG_RAD = 1 - 1e-7, np.radians(5.0)


class Following:
    """Measures pair after pair, 1/60 s apart: following where armsight can, else searching every shot.

    Attributes:
        way: how the last shot was measured: followed, searched or lost.
    """

    def __init__(self, rig: StereoRig, target: DiscTarget) -> None:
        self.way = "searched"
        self._count, self.follower = 0, Follower(rig, opened(target))

    def __call__(self, left: np.ndarray, right: np.ndarray) -> PoseEstimate | Missed:
        self._count += 1
        shot = Shot(str(self._count), left, right, self._count / RATE_HZ)
        result = self.follower.measure(shot)
        self.way = self.follower.way
        return result


@dataclass
class Moment:
    """One shot of a path.

    Attributes:
        T: truth.
        images: both.
        whole: whether every disc shows whole in both images.
        hidden: how many of the discs' images are covered, in part or whole.
    """

    T: np.ndarray
    images: tuple[np.ndarray, np.ndarray]
    whole: bool
    hidden: int


def path(shots: int) -> list[np.ndarray]:
    """Return poses along a closed way at constant speed, rotating as it goes."""
    t = np.linspace(0, 2 * np.pi, 4000)
    way = np.stack([0.11 + 0.2 * np.sin(t), 0.1 * np.sin(2 * t), 0.85 + 0.15 * np.cos(t)], axis=1)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))]
    out = []
    for k in range(shots):
        s = np.interp((k * SPEED / RATE_HZ) % length[-1], length, t)
        p = np.stack([np.interp(s, t, way[:, i]) for i in range(3)])
        R = exp_so3(np.array([0.35 * np.sin(s), 0.4 * np.cos(2 * s), 0.0])) @ exp_so3(
            np.array([0.0, 0.0, 0.6 * np.sin(s)])
        )
        out.append(pose(R, p))
    return out


def occlusions(shots: int, rng: np.random.Generator) -> np.ndarray:
    """Return (shots, 2, 4) how far each disc in each image, and the whole plate (last), is covered: 0 to 1."""
    out = np.zeros((shots, 2, 4))
    k = 12
    while k < shots:
        length = int(rng.integers(1, 12))
        side, what = int(rng.integers(0, 2)), int(rng.integers(0, 4))
        share = 1.0 if rng.random() < 0.6 else rng.uniform(0.2, 0.9)
        out[k : k + length, side if rng.random() < 0.5 else slice(None), what] = 1.0 if what == 3 else share
        k += length + int(rng.integers(3, 25)) - (2 if rng.random() < 0.2 else 0)
    return out


def moments(rig: StereoRig, target: DiscTarget, shots: int, rng: np.random.Generator):
    """Yield the shots of the path; something of the background's level comes in from a random side."""
    covered = occlusions(shots, rng)
    for k, T in enumerate(path(shots)):
        assert in_view(rig, target, T)
        images = []
        for side, (camera, at) in enumerate(zip(rig.cameras, views(rig, T), strict=True)):
            light = light_of(camera, target, at)
            uv, shape = ellipses(camera, target, at)
            angle = rng.uniform(0, 2 * np.pi)
            across, down = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
            for disc, share in enumerate(covered[k, side]):
                if share == 0:
                    continue
                middle = uv[disc] if disc < 3 else uv.mean(axis=0)
                size = 1.8 * np.sqrt(shape.max()) if disc < 3 else np.abs(uv - middle).max() + 4 * np.sqrt(shape.max())
                # A square that stands over the disc, moved off so that it covers about its share.
                centre = middle + (2 * (1 - share) * size if disc < 3 else 0.0) * across
                corners = np.array([across + down, down - across, -across - down, across - down]) * size + centre
                cover_up(light, corners, BLUR)
            images.append(exposed(light, NOISE, 0.0, rng))
        hidden = int((covered[k, :, :3] > 0).sum()) if not covered[k, :, 3].any() else 6
        yield Moment(T, (images[0], images[1]), hidden == 0, hidden)


def metric(seed: int, report: Report, shots: int = 900) -> None:
    rng, rig, target = np.random.default_rng(seed), parallel_rig(LENS, 3.0), disc_target()
    follow = Following(rig, target)
    limit = chi2.ppf(WRONG_QUANTILE, 6)
    # Shots since the whole plate shows, whether the last one gave no pose, and how many whole shots each regain took.
    run, lost, regained = 0, False, []
    wrong = losses = measured_in_part = in_part = missed_whole = 0
    nees, reasons, ways = [], Counter(), Counter()
    for moment in moments(rig, target, shots, rng):
        result = follow(*moment.images)
        ways[follow.way] += 1
        run = run + 1 if moment.whole else 0
        in_part += not moment.whole
        if isinstance(result, Missed):
            losses, missed_whole = losses + (not lost), missed_whole + moment.whole
            lost = True
            reasons[without_numbers(result.reason)] += 1
            continue
        if lost and run:
            regained.append(run)
        lost = False
        measured_in_part += not moment.whole
        xi = log_se3(inverse(result.T_left_body) @ moment.T)
        nees.append(xi @ np.linalg.solve(result.cov, xi))
        wrong += nees[-1] > limit or np.linalg.norm(xi[3:]) > WRONG_RAD
    if lost and run:
        regained.append(run + 1)
    report.say(
        f"  {shots} shots, {SPEED} m/s at {RATE_HZ:g} Hz: {shots - in_part} with the whole plate in both images, "
        f"{missed_whole} of them missed; of {in_part} with something covered {measured_in_part} measured; {losses} losses"
    )
    report.say(f"  {', '.join(f'{times} {way}' for way, times in ways.most_common())}")
    report.metric("wrong poses", wrong, "0", form="d", good=wrong == 0)
    if regained:
        most = max(regained)
        report.metric(
            "shots to regain once the whole plate shows again, at most", most, "<= 2", form="d", good=most <= 2
        )
    if nees:
        report.metric("mean NEES (6 is honest)", np.mean(nees), form=".2f")
    if reasons:
        for reason, times in reasons.most_common(5):
            report.say(f"    missed {times} times: {reason}")
