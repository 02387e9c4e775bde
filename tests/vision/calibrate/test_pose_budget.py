"""The budget of a pose against plain Monte Carlo: the real pose fit on perturbed pixels, rigs and bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armsight.data import Array
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose
from armsight.sim.workcell.body import body_target
from armsight.vision.calibrate.budget import (
    Budget,
    Conditions,
    Gates,
    calibration_covariance,
    gates,
    of_three,
    pose_budget,
    radius,
    volume_views,
)
from armsight.vision.markers.tag import Tag, TagTarget
from armsight.vision.markers.targets import Composite
from armsight.vision.match import epipolar_distances
from armsight.vision.pose.posefit import PixelObservations, fit_pose
from armsight.vision.pose.predict import plain_rig, view

RIG = plain_rig(1000.0, 0.25)
DISCS = body_target().discs
assert DISCS is not None
POINTS, NORMALS = DISCS.body.points, DISCS.normals
VIEWS = volume_views(RIG, POINTS, NORMALS, 0.8, np.array([0.2, 0.1, 0.1]))
SHOTS = 600


def measured(given: Conditions, rng: np.random.Generator, cameras: int = 2) -> Array:
    """Return errors (SHOTS, 6) along the left camera's axes, each shot at a position of its own, by the real fit."""
    errors = []
    for shot in range(SHOTS):
        seen = VIEWS[shot % len(VIEWS)]
        T = seen.T_left_body
        v = np.repeat(np.array([given.speed_m_s, given.rotation_rad_s]) / np.sqrt(3), 3) * rng.standard_normal(6)
        out = NORMALS * (rng.standard_normal((len(POINTS), 1)) * given.body_sigma_m[1])
        across = rng.standard_normal(POINTS.shape) * given.body_sigma_m[0]
        across -= (across * NORMALS).sum(axis=1, keepdims=True) * NORMALS
        body = POINTS * (1 + given.body_scale * rng.standard_normal()) + out + across
        rig = RIG
        if given.lens_share:
            moved = np.zeros(RIG.parameter_count)
            moved[0:2] = given.lens_share * rng.standard_normal() * RIG.left.intrinsics[:2]
            moved[4:6] = given.lens_share * rng.standard_normal() * RIG.right.intrinsics[:2]
            rig = RIG.perturbed(moved)
        side, row = (each.astype(np.int64) for each in np.nonzero(seen.seen[:, :cameras].T))
        uv = np.zeros((len(row), 2))
        start = rng.standard_normal() * given.start_s
        for k in (0, 1):
            p, late = body[row[side == k]], np.full((side == k).sum(), k * (given.skew_s + start))
            for _ in range(2 if given.readout_s else 1):
                Ts = T @ exp_se3(late[:, None] * v)
                at = rig.project(np.einsum("nij,nj->ni", Ts[:, :3, :3], p) + Ts[:, :3, 3])[k]
                uv[side == k] = at
                rows = at[:, 1] / (RIG.left.image_size_px[1] - 1) - 0.5
                late = k * (given.skew_s + start) + given.readout_s * rows
        both = np.intersect1d(row[side == 0], row[side == 1])
        pairs = [uv[side == k][np.isin(row[side == k], both)] for k in (0, 1)]
        if cameras == 2:
            still = body[both] @ T[:3, :3].T + T[:3, 3]
            across_px, along_px = (
                epipolar_distances(RIG, *pairs).mean(),
                (pairs[1] - RIG.project(still)[1])[:, 0].mean(),
            )
            if (
                across_px > 1000 * given.gate.across_rad
                or abs(along_px) * still[:, 2].mean() / 1000 > given.gate.along_m
            ):
                continue  # lost
        sigma = float(np.sqrt(sum(s**2 for s in given.noise_px.values())))
        uv += sigma * rng.standard_normal(uv.shape)
        found = fit_pose(
            RIG.cameras,
            RIG.T_left_right,
            POINTS,
            PixelObservations(side, row, uv, np.tile(np.eye(2), (len(row), 1, 1))),
            T,
            robust=False,
        )
        assert found is not None
        error = log_se3(inverse(T) @ found.T_left_body)
        errors.append(np.kron(np.eye(2), T[:3, :3]) @ error)
    return np.array(errors)


CASES = {
    "pixel noise": Conditions({"pixel noise": 0.1}),
    "skew": Conditions(skew_s=0.004, speed_m_s=0.3, rotation_rad_s=0.2),
    "start of exposures": Conditions(start_s=0.003, speed_m_s=0.3),
    "readout": Conditions(readout_s=0.02, speed_m_s=0.2, rotation_rad_s=0.2),
    "print of the body": Conditions(body_sigma_m=(1e-4, 3e-4), body_scale=1e-3),
    "warming of the lenses": Conditions(lens_share=2e-4),
    "a gate": Conditions(skew_s=0.004, speed_m_s=0.3, gate=Gates(across_rad=8e-4)),
    "a gate along the baseline": Conditions(skew_s=0.004, speed_m_s=0.3, gate=Gates(along_m=6e-4)),
    "skew and readout": Conditions(skew_s=0.004, readout_s=-0.006, speed_m_s=0.3),
}


@pytest.mark.parametrize("case", CASES)
def test_a_cause_costs_what_the_fit_shows(case: str) -> None:
    # The RMS of 600 errors of three axes is known to 1 / sqrt(3600) = 1.7 %, of one dominant axis to 2.9 %; a shared
    # velocity or lens has fewer degrees of freedom than the axes: four sigmas of the latter.
    given = CASES[case]
    found = pose_budget(RIG, POINTS, NORMALS, VIEWS, given)
    errors = measured(given, np.random.default_rng(7))
    position, rotation = found.rms(found.cov())
    assert np.sqrt((errors[:, :3] ** 2).sum(axis=1).mean()) == pytest.approx(position, rel=0.12)
    assert np.sqrt((errors[:, 3:] ** 2).sum(axis=1).mean()) == pytest.approx(rotation, rel=0.12)


@pytest.mark.parametrize("case", ["pixel noise", "print of the body"])
def test_one_camera_is_as_good_as_its_fit_shows(case: str) -> None:
    # Depth alone dominates: 600 errors of one axis are known to 2.9 %, four sigmas; the fit is linear to that.
    views = [replace(each, seen=each.seen[:, :1]) for each in VIEWS]
    found = pose_budget(RIG, POINTS, NORMALS, views, CASES[case])
    errors = measured(CASES[case], np.random.default_rng(8), cameras=1)
    assert np.sqrt((errors[:, :3] ** 2).sum(axis=1).mean()) == pytest.approx(found.rms(found.cov())[0], rel=0.12)


def test_three_cameras_are_the_mean_of_their_pairs() -> None:
    # The oracle: three pinholes at the corners of the triangle, whose pairs are fitted and averaged. Pixels of a camera act
    # on its two pairs not quite alike; "counts twice" is the most that they can cost. A larger board moves all three away
    # from the first: to the 2 % of a pair's own lateral part.
    size, given = np.array([0.2, 0.1, 0.1]), Conditions({"pixel noise": 0.1}, board_scale=1e-3)
    pairs = [volume_views(RIG, POINTS, NORMALS, 0.8, size, pair) for pair in range(3)]
    found = of_three([pose_budget(RIG, POINTS, NORMALS, views, given) for views in pairs], RIG, given.board_scale)
    b, covs, larger = RIG.baseline_m, [], []
    for seen in pairs[0]:
        T = seen.T_left_body
        rows, moved = [], []
        for at in np.array([[0.0, 0.0, 0.0], [b, 0.0, 0.0], [b / 2, b * np.sqrt(3) / 2, 0.0]]):

            def uv(x: Array, T: Array = T, at: Array = at) -> Array:
                p = POINTS @ (T @ exp_se3(x))[:3, :3].T + (T @ exp_se3(x))[:3, 3] - at
                return np.asarray((1000.0 * p[:, :2] / p[:, 2:]).ravel())

            rows.append(np.column_stack([(uv(h) - uv(-h)) / 2e-5 for h in 1e-5 * np.eye(6)]))
            moved.append(uv(np.zeros(6), at=at * 1.001) - uv(np.zeros(6)))
        gains, n = np.zeros((6, 3 * len(moved[0]))), len(moved[0])
        for pair in ([0, 1], [1, 2], [2, 0]):
            columns = np.concatenate([np.arange(k * n, (k + 1) * n) for k in pair])
            gains[:, columns] += np.linalg.pinv(np.concatenate([rows[k] for k in pair])) / 3
        R = np.kron(np.eye(2), T[:3, :3])
        covs.append(R @ gains @ gains.T @ R.T * 0.01)
        larger.append(-(R @ gains @ np.concatenate(moved))[:3])
    for most, exact in zip(found.rms(found.cov(of="pixel noise")), found.rms(np.array(covs)), strict=True):
        assert 0.75 * most < exact < 1.001 * most
    np.testing.assert_allclose(found.factors["print of the board"][:, :3, 0], larger, atol=2e-2 * np.abs(larger).max())


def test_shared_velocity_adds_before_it_is_squared() -> None:
    both = pose_budget(RIG, POINTS, NORMALS, VIEWS, CASES["skew and readout"])
    apart = both.cov(of="skew") + both.cov(of="readout")
    assert abs(np.trace(both.cov()[0]) / np.trace(apart[0]) - 1) > 0.02


@pytest.mark.parametrize("case", ["a gate", "a gate along the baseline"])
def test_shots_beyond_the_gate_are_lost(case: str) -> None:
    # A share of 600 shots near 0.35 is known to 0.019: three sigmas.
    found = pose_budget(RIG, POINTS, NORMALS, VIEWS, CASES[case])
    shots = measured(CASES[case], np.random.default_rng(9))
    assert 0.2 < found.lost.mean() < 0.5
    assert 1 - len(shots) / SHOTS == pytest.approx(found.lost.mean(), abs=0.06)
    assert not pose_budget(RIG, POINTS, NORMALS, VIEWS, CASES["skew"]).lost.any()
    # Without what is lost the others are better.
    skew = pose_budget(RIG, POINTS, NORMALS, VIEWS, CASES["skew"])
    assert found.rms(found.cov())[0] < skew.rms(skew.cov())[0]


def test_gates_are_those_of_measure() -> None:
    # Of tags of 40 px or more: 2 px from the epipolar line, and 2 % of the size, which is the baseline's; known to 1/64
    # of what four sigmas reach, and a ray is up to 1.05 times as long as its depth.
    tags = [
        Tag(f"t{k}", "tag36h11", k, 0.05, pose(np.eye(3), np.array([0.07 * k, 0.05 * (k % 2), 0.0]))) for k in range(4)
    ]
    body = Composite("tags", (TagTarget("tags", tuple(tags)),))
    seen = view(RIG, body.body.points, body.normals, 0.8)
    across, along, together = gates(RIG, body, seen, 0.02, 0.003)
    assert not together  # two tests, one after the other
    assert across == pytest.approx(2e-3, rel=0.15)
    assert along == pytest.approx(0.02 * RIG.baseline_m, rel=0.1)
    assert gates(RIG, body, seen, 0.02, 3e-4) == Gates()  # no motion reaches them
    assert gates(RIG, body, seen, 0.02, 0.0) == Gates()


def test_points_of_one_marker_move_together() -> None:
    # Of a body that is one marker, what it is off by shifts the pose by as much.
    given = Conditions(body_sigma_m=(2e-4, 2e-4), marker=np.zeros(len(POINTS), np.int64))
    found = pose_budget(RIG, POINTS, NORMALS, VIEWS, given)
    assert found.rms(found.cov()) == pytest.approx((2e-4 * np.sqrt(3), 0.0), rel=1e-6, abs=1e-9)


def test_a_lost_cause_is_none_at_rest() -> None:
    found = pose_budget(RIG, POINTS, NORMALS, VIEWS, CASES["skew"])
    assert not found.cov(moving=False).any()


def test_what_stands_in_the_calibration_is_what_boards_determine() -> None:
    # Four times the pairs at the same poses: half the standard deviation.
    from armsight.sim.example_rig import board_poses
    from armsight.sim.render.scene import chessboard
    from armsight.vision.markers.board import open_board

    board = open_board("chessboard:9x6:30mm").body.points
    Ts = board_poses(np.random.default_rng(3), RIG, chessboard(9, 6, 0.03), 12)
    once, four = (calibration_covariance(RIG, board, np.tile(Ts, (n, 1, 1)), 0.1) for n in (1, 4))
    np.testing.assert_allclose(np.sqrt(np.diag(four)), np.sqrt(np.diag(once)) / 2, rtol=0.02)  # of drawn corners
    bent = calibration_covariance(RIG, board, Ts, 0.1, 2e-4)
    assert (np.diag(bent) > np.diag(once)).all()


def test_a_calibration_is_as_good_as_the_bundle_of_noisy_corners() -> None:
    # 60 bundles: the RMS over 22 parameters is known to 1 / sqrt(2 * 60) = 9 % each, to some 3 % together; without the
    # robust loss's price it was 9 % too small.
    from armsight.sim.example_rig import board_poses
    from armsight.sim.render.scene import chessboard
    from armsight.vision.calibrate.boards import rigid_board
    from armsight.vision.markers.board import open_board
    from armsight.vision.pose.bundle import BundleState, Observations, minimise

    board, rng, off = open_board("chessboard:9x6:30mm").body.points, np.random.default_rng(5), []
    Ts = board_poses(rng, RIG, chessboard(9, 6, 0.03), 12)
    expected = np.sqrt(np.diag(calibration_covariance(RIG, board, Ts, 0.1)))
    p = np.einsum("sij,mj->smi", Ts[:, :3, :3], board) + Ts[:, None, :3, 3]
    true = np.stack([each.reshape(12, -1, 2) for each in RIG.project(p.reshape(-1, 3))], axis=1).reshape(-1, 2)
    shot, point = np.repeat(np.arange(12), 2 * len(board)), np.tile(np.arange(len(board)), 24)
    side = np.tile(np.repeat([0, 1], len(board)), 12)
    for _ in range(60):
        uv = true + 0.1 * rng.standard_normal(true.shape)
        seen = Observations(shot, side, point, uv, np.zeros((len(uv), 2, 2)), 12)
        state = minimise(
            rigid_board(board), BundleState(RIG.cameras, RIG.T_left_right, Ts, np.zeros(0)), seen, 0.1
        ).state
        cameras = [a.parameters - b.parameters for a, b in zip(state.cameras, RIG.cameras, strict=True)]
        off.append(np.concatenate([*cameras, log_se3(inverse(RIG.T_left_right) @ state.T_left_right)]) / expected)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("sizes", [(1.0, 1.0, 1.0), (1.0, 0.1, 0.1), (2.0, 1.0, 0.0)])
def test_radius_holds_95_percent(sizes: tuple[float, float, float]) -> None:
    e = np.random.default_rng(0).standard_normal((200_000, 3)) * sizes
    inside = np.linalg.norm(e, axis=1) < radius(np.diag(np.square(sizes))[None])[0]
    assert inside.mean() == pytest.approx(0.95, abs=0.01)


def test_a_budget_has_both_shares() -> None:
    found: Budget = pose_budget(RIG, POINTS, NORMALS, VIEWS, Conditions({"pixel noise": 0.1}, lens_share=1e-4))
    whole = found.cov(of="precision") + found.cov(of="trueness")
    np.testing.assert_allclose(whole, found.cov(), rtol=1e-12)
