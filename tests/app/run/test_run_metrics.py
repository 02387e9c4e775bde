"""Tracks, their files and their metrics, against slow obvious versions."""

import csv

import numpy as np
import pytest

from armsight.app.run.metrics import Spread, path_distances, spread, track_metrics
from armsight.app.run.tracks import ToolTrack, columns, errors, write_columns
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.geometry.rotation import from_quaternion_wxyz


def track(n=40, seed=0, spread_m=0.3, cov=None):
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 2.0, n)
    twists = np.stack(
        [spread_m * np.sin(t * w + p) for w, p in zip(rng.uniform(0.5, 2, 6), rng.uniform(0, 6, 6), strict=True)], 1
    )
    Ts = exp_se3(twists)
    covs = None if cov is None else np.tile(cov, (n, 1, 1))
    return ToolTrack(t, Ts, np.full(n, "open_loop"), np.full(n, "line"), covs)


def test_errors_are_the_tangents_from_the_estimate_to_the_truth():
    truth = track()
    rng = np.random.default_rng(1)
    xi = 1e-4 * rng.standard_normal((40, 6))
    estimate = ToolTrack(truth.t_s, truth.Ts_base_tool @ exp_se3(xi), truth.phase, truth.motion)
    expected = [
        log_se3(inverse(T) @ T_true) for T, T_true in zip(estimate.Ts_base_tool, truth.Ts_base_tool, strict=True)
    ]
    # The shift is taken straight, not along the screw: they differ by half the product of shift and rotation.
    assert np.abs(errors(estimate, truth) - expected).max() < 0.5 * np.abs(xi).max() ** 2 * 6


def test_between_its_rows_a_track_is_linear_and_rotates_evenly():
    truth = track(n=2001)
    rows = np.arange(0, 2001, 10)
    coarse = truth[rows]
    # Half a step of 10 ms: curvature a t^2 / 8 with a below 4 x 0.3 m/s^2 (and rad/s^2).
    off = errors(ToolTrack(truth.t_s, coarse.at(truth.t_s), truth.phase, truth.motion), truth)
    assert np.abs(off).max() < 2 * 4 * 0.3 * 0.01**2 / 8


def test_the_metrics_of_noise_with_a_known_covariance():
    truth = track(n=4000)
    sigma = np.array([1e-4, 2e-4, 3e-4, 1e-3, 1e-3, 2e-3])
    xi = sigma * np.random.default_rng(2).standard_normal((4000, 6))
    covs = np.tile(np.diag(sigma**2), (4000, 1, 1))
    found = track_metrics(
        ToolTrack(truth.t_s, truth.Ts_base_tool @ exp_se3(-xi), truth.phase, truth.motion, covs), truth
    )
    assert found.position_rms_m == pytest.approx(np.linalg.norm(sigma[:3]), rel=0.03)
    assert found.position_sigma_rms_m == pytest.approx(np.linalg.norm(sigma[:3]))
    assert found.nees_mean == pytest.approx(6.0, abs=4 * np.sqrt(12 / 4000))
    assert found.inside_95_share == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / 4000))


def test_the_files_hold_what_the_track_holds(tmp_path):
    whole = track(cov=np.diag([1e-8, 4e-8, 9e-8, 1e-6, 1e-6, 1e-6]))
    write_columns(tmp_path, "vision", [columns(whole)])
    rows = list(csv.DictReader((tmp_path / "vision.csv").read_text().splitlines()))
    assert len(rows) == 40
    assert list(rows[0])[:8] == ["t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]
    for row, T in zip(rows, whole.Ts_base_tool, strict=True):
        assert [float(row[f"{a}_m"]) for a in "xyz"] == pytest.approx(T[:3, 3], abs=1e-9)
        R = from_quaternion_wxyz(np.array([float(row[f"q{a}"]) for a in "wxyz"]))
        assert np.abs(R - T[:3, :3]).max() < 5e-9
        own = T[:3, :3] @ np.diag([1e-8, 4e-8, 9e-8]) @ T[:3, :3].T  # along the base's axes
        assert float(row["sigma_x_m"]) == pytest.approx(np.sqrt(own[0, 0]), abs=1e-9)
    assert {row["phase"] for row in rows} == {"open_loop"}


def test_a_track_that_cannot_be_written_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match="there is no folder"):
        write_columns(tmp_path / "missing", "vision", [columns(track())])


def test_distances_from_a_path_do_not_ask_when():
    t = np.linspace(0, 2 * np.pi, 400)
    circle = np.stack([np.cos(t), np.sin(t), 0 * t], 1)
    late = np.stack([1.01 * np.cos(t - 0.5), 1.01 * np.sin(t - 0.5), 0 * t], 1)[100:300]
    # A chord of the given path lies 1 - cos(pi / 399) within the circle.
    assert path_distances(late, circle) == pytest.approx(np.full(200, 0.01), abs=4e-5)


def test_spread_is_numpys():
    values = np.random.default_rng(3).exponential(size=999)
    assert spread(values) == Spread(*np.percentile(values, [50, 99, 99.9, 100]))
