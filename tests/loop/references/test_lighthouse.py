"""Lighthouse sweeps: derivatives, closed forms, the bundle with a body in motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armsight.data import Array
from armsight.errors import CalibrationError, InputError
from armsight.geometry.pose import exp_se3
from armsight.geometry.rotation import exp_so3
from armsight.loop.references.lighthouse import SLANT, Lighthouse, Sweeps, beginning, follow, sweep_angle, triangulated
from armsight.loop.references.reference import ToolMotion

NOISE_RAD, STEP = 40e-6, 1e-6
DIODES = np.array([[-0.015, 0.0075, 0.0], [-0.015, -0.0075, 0.0], [0.015, 0.0075, 0.0], [0.015, -0.0075, 0.0]])  # m


def _looking_at(eye: Array, at: Array) -> Array:
    x = (at - eye) / np.linalg.norm(at - eye)
    y = np.cross([0.0, 0.0, 1.0], x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([x, y / np.linalg.norm(y), np.cross(x, y) / np.linalg.norm(y)]), eye
    return T


def _beacons() -> Lighthouse:
    Ts = np.stack([_looking_at(np.array(eye), np.zeros(3)) for eye in ([-2.0, 0.3, 1.5], [0.3, -2.2, 1.4])])
    planes = [[0.002, -0.05, -0.3, 0.001, 1.0, -0.3, 1.2], [-0.003, 0.05, 0.4, -0.002, 0.5, -0.3, 2.0]]
    sigma = np.concatenate([np.full(3, 0.05), np.full(3, 0.02), np.full(14, 1e-9)])
    cov = np.diag(np.tile(sigma**2, 2))
    return Lighthouse(
        name="lighthouse", cov=cov, Ts_base_beacon=Ts, calibration=np.array([planes, planes[::-1]]), receivers=DIODES
    )


def _moving(t: Array) -> tuple[Array, Array]:
    p = np.stack([0.4 * np.sin(1.1 * t), 0.4 * np.sin(1.7 * t + 1), 0.2 * np.sin(2.3 * t + 2)], axis=1)
    w = np.stack([0.3 * np.sin(0.9 * t), 0.3 * np.cos(1.3 * t), 0.8 * np.sin(0.7 * t)], axis=1)
    return p, exp_so3(w)


def _sweeps(beacons: Lighthouse, seconds: float, seed: int, reflected: float = 0.0, pace: float = 1.0) -> Sweeps:
    rng = np.random.default_rng(seed)
    t, receiver, beacon, plane = [], [], [], []
    for b in (0, 1):
        for start in np.arange(0.0, seconds, 1 / 50 + 1e-4 * b):
            for k in (0, 1):
                t.append(start + (0.007 + 0.006 * k + 1e-4 * np.arange(4)))
                receiver.append(np.arange(4))
                beacon.append(np.full(4, b))
                plane.append(np.full(4, k))
    parts = [np.concatenate(each) for each in (t, receiver, beacon, plane)]
    s = Sweeps(*parts, np.zeros(len(parts[0])))
    angle = beacons.along(s, *_moving(pace * s.t_s))[0] + NOISE_RAD * rng.standard_normal(len(s.t_s))
    lost = rng.random(len(angle)) < reflected
    return s._replace(angle=np.where(lost, angle + rng.uniform(-0.5, 0.5, len(angle)), angle))


def test_an_ideal_plane_is_slanted_by_30_degrees() -> None:
    p = np.array([[2.0, 0.3, 0.4], [1.5, -0.5, -0.6]])
    for plane, slant in ((0, SLANT), (1, -SLANT)):
        angle = sweep_angle(p, np.full(2, plane), np.zeros((2, 7)))
        n = np.stack([-np.sin(angle), np.cos(angle), np.full(2, -np.tan(slant))], axis=1)
        np.testing.assert_allclose(np.einsum("ni,ni->n", n, p), 0.0, atol=1e-12)


def test_derivatives_agree_with_differences() -> None:
    beacons, T = _beacons(), exp_se3(np.array([0.1, -0.2, 0.1, 0.2, 0.1, 0.5]))
    for channel in (0, 6, 13):
        z, by_tool, by_parameters, *_ = beacons.expected(ToolMotion(T), channel)
        tool = [beacons.expected(ToolMotion(T @ exp_se3(d)), channel).z - z for d in STEP * np.eye(6)]
        own = [beacons.moved(d).expected(ToolMotion(T), channel).z - z for d in STEP * np.eye(40)]
        np.testing.assert_allclose(by_tool.T, np.array(tool) / STEP, atol=1e-5)
        np.testing.assert_allclose(by_parameters.T, np.array(own) / STEP, atol=1e-5)


def test_a_pose_in_closed_form_and_one_beacon_is_rejected() -> None:
    beacons, s = _beacons(), _sweeps(_beacons(), 0.02, 0)
    p, R = np.array([0.2, 0.1, -0.1]), exp_so3(np.array([0.1, 0.2, 0.7]))
    s = s._replace(angle=beacons.along(s, np.tile(p, (len(s.t_s), 1)), np.tile(R, (len(s.t_s), 1, 1)))[0])
    found, rotated, off = beacons.pose_of(s)
    assert np.linalg.norm(found - p) < 1e-5
    assert np.abs(rotated - R).max() < 0.02
    assert off < 1e-5
    with pytest.raises(CalibrationError, match="two beacons"):
        beacons.pose_of(s.rows(s.beacon == 0))


def test_the_bundle_finds_the_beacons_while_the_body_moves() -> None:
    true = _beacons()
    off = 0.7 * np.sqrt(np.diag(true.cov)) * np.random.default_rng(5).standard_normal(40)
    s = _sweeps(true, 3.0, 6, reflected=0.05)
    begin = true.moved(off)
    path = follow(begin, s, *beginning(begin, s))
    k = np.arange(10, len(path.t_s) - 10, 8)
    p, _ = _moving(path.t_s[k])
    # Beacons and path may move as one: relative to the first beacon.
    T = true.Ts_base_beacon[0] @ np.linalg.inv(path.reference.Ts_base_beacon[0])
    apart = np.linalg.norm(path.p[k] @ T[:3, :3].T + T[:3, 3] - p, axis=1)
    assert np.median(apart) < 2.5e-3  # distances by a deck of 30 mm; the beacons began 50 mm off
    assert NOISE_RAD / 1.3 < path.sigma_rad < NOISE_RAD * 1.5
    assert 0.9 < path.used.mean() < 0.97
    e = np.concatenate([path.p[k] - p, np.zeros_like(p)], axis=1)
    cov = path.covariance(k)
    assert np.mean(np.einsum("ki,kij,kj->k", e[:, :3], np.linalg.inv(cov[:, :3, :3]), e[:, :3])) / 3 < 4


@pytest.mark.parametrize("pace", [0.0, 0.02, 1.0])
def test_acceleration_is_as_large_as_the_path_shows_and_a_rest_is_one(pace: float) -> None:
    true = _beacons()
    known, s = replace(true, cov=0 * true.cov), _sweeps(true, 4.0, 12, 0.02, pace)
    path = follow(known, s, *beginning(known, s))
    k = np.arange(10, len(path.t_s) - 10, 5)
    e, cov = path.p[k] - _moving(pace * path.t_s[k])[0], path.covariance(k)[:, :3, :3]
    assert np.sqrt((e**2).sum(axis=1).mean()) < (3e-5 if pace < 0.1 else 2e-4)
    assert np.mean(np.einsum("ki,kij,kj->k", e, np.linalg.inv(cov), e)) / 3 < 3


@pytest.mark.parametrize("seed", [40, 45])
def test_three_knots_are_a_path_and_two_are_rejected(seed: int) -> None:
    true, s, t = _beacons(), _sweeps(_beacons(), 4.0, seed, 0.0, 0.0), 1.0 + np.arange(3) / 40
    known, s = replace(true, cov=0 * true.cov), s.rows((s.t_s >= t[0]) & (s.t_s <= t[-1]))
    p, R = _moving(0.0 * t)
    e = follow(known, s, t, p, R).p - p
    assert np.abs(e).max() < 5e-4
    with pytest.raises(InputError, match="lighthouse: 2 knots were given; a path needs three at least"):
        follow(known, s, t[:2], p[:2], R[:2])


def test_a_point_triangulated_from_beacons_has_an_honest_covariance() -> None:
    rng, sigma, p = np.random.default_rng(8), 1e-3, np.array([0.2, -0.1, 0.3])
    Ts = np.stack([_looking_at(np.array(eye), p + 0.1) for eye in ([2.0, 0, 1], [0, 2.0, 0.5], [-1.5, -1, 0.4])])
    for count in (2, 3):
        errors, covs = [], []
        for _ in range(200):
            u = np.einsum("bji,bj->bi", Ts[:count, :3, :3], p - Ts[:count, :3, 3])
            u /= np.linalg.norm(u, axis=1)[:, None]
            rotated = exp_so3(sigma * rng.standard_normal((count, 3)))
            found, cov = triangulated(np.einsum("bij,bj->bi", rotated, u), Ts[:count], np.full(count, sigma**2))
            errors.append(found - p)
            covs.append(cov)
        nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covs), errors).mean() / 3
        assert 0.85 < nees < 1.15  # three sigma of 600 numbers
    with pytest.raises(CalibrationError, match="one line"):
        triangulated(np.tile([1.0, 0, 0], (2, 1)), np.stack([np.eye(4), exp_se3(np.eye(6)[0])]), np.ones(2))


def test_parameters_are_named_in_the_tangents_order() -> None:
    beacons = _beacons()
    names = list(beacons.parameters)
    assert len(names) == len(beacons.cov)
    moved = beacons.moved(1e-3 * (np.arange(40) == 6))
    assert moved.parameters["beacon1_plane1_phase"] - beacons.parameters["beacon1_plane1_phase"] == pytest.approx(1e-3)
    assert names[20] == "beacon2_x_m"
