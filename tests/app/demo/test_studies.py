"""The studies of vision: each changes one thing, and what it reports is what was measured."""

import functools
import itertools
import time
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.demo import demo
from armsight.app.demo.demo import Demo, vision_studies
from armsight.data import Missed, PoseEstimate
from armsight.geometry.pose import pose

SHOTS = 400
#: What a study's values do to the error: its power.
POWERS = {"distance": 2, "baseline": -1, "image width": -1, "pixel noise": 1}


class MadeUp:
    """Rendering, measuring and calibrating by a law: errors of z^2 / (b f) times the noise, every hundredth shot missed.

    A calibration of n pairs is off by a metre / sqrt(n), the same for all shots that are measured with it.
    """

    def __init__(self):
        self.shown, self.count, self.calibrations = {}, itertools.count(), 0

    def render_pair(self, cameras, T_left_right, placed, behind, *, sensor=None, rng):
        number = next(self.count)
        self.shown[number] = placed[0].T_camera_body, sensor.read_noise if sensor else 0.0
        return np.full((2, 1, 1), number, np.uint16)

    def calibrate_boards(self, board, pairs, sizes, **options):
        self.calibrations += 1
        off = np.random.default_rng([7, self.calibrations]).normal() / np.sqrt(len(pairs))
        camera = SimpleNamespace(intrinsics=np.array([900.0]))
        return SimpleNamespace(rig=SimpleNamespace(left=camera, baseline_m=0.2, off=off, variance=1 / len(pairs)))

    def measure(self, rig, target, shot):
        T, noise = self.shown[int(shot.left[0, 0])]
        if int(shot.name) % 100 == 0:
            return Missed("made up")
        f = rig.left.intrinsics[0]
        sigma = 1e-2 * noise * T[2, 3] ** 2 / (rig.baseline_m * f)
        rng = np.random.default_rng(
            [int(shot.name), int(1e6 * T[2, 3]), int(1e3 * noise), int(1e3 * rig.baseline_m), int(f)]
        )
        error = np.array([*(sigma * rng.normal(size=2)), getattr(rig, "off", 0.0)])
        cov = np.diag([sigma**2, sigma**2, getattr(rig, "variance", 0.0), 0.0, 0.0, 0.0])
        return PoseEstimate(T @ pose(np.eye(3), -error), cov, cov, 0.0, 0.0, 1.0, None)


@pytest.fixture(scope="module")
def by_law():
    law, said = MadeUp(), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "open_board", lambda spec: SimpleNamespace(detect=lambda image: None))
        patch.setattr(demo, "Pair", lambda *what: what)
        patch.setattr(demo, "calibrate_boards", law.calibrate_boards)
        patch.setattr(demo, "plain", lambda size, rng: None)
        patch.setattr(demo, "render_pair", law.render_pair)
        patch.setattr(demo, "measure", law.measure)
        found = vision_studies(seed=3, shots=SHOTS, progress=said.append)
    return {study.name: study for study in found}, said


def test_every_study_is_made_and_reported(by_law):
    found, said = by_law
    assert list(found) == [*POWERS, "calibration size"]
    assert all(any(name in line for line in said) for name in ("distance", "baseline", "32 pairs"))


@pytest.mark.parametrize("name", POWERS)
def test_a_study_changes_what_it_names_and_nothing_else(by_law, name):
    study = by_law[0][name]
    predicted = study.predicted_m / study.values ** POWERS[name]
    np.testing.assert_allclose(predicted, predicted[0], rtol=1e-9)


@pytest.mark.parametrize("name", POWERS)
def test_the_measured_error_is_that_of_the_law_and_misses_are_counted(by_law, name):
    study = by_law[0][name]
    # 396 shots of two errors each determine a deviation to 1 / sqrt(4 * 396) = 2.5 %.
    np.testing.assert_allclose(study.position_rms_m, study.predicted_m, rtol=5 * 0.025)
    assert study.missed.tolist() == [4] * len(study.values)


def test_the_interval_holds_the_true_error_19_times_out_of_20(by_law):
    found = [by_law[0][name] for name in POWERS]
    low, high, predicted, rms = (
        np.concatenate([getattr(study, name) for study in found])
        for name in ("low_m", "high_m", "predicted_m", "position_rms_m")
    )
    inside = (low < predicted) & (predicted < high)
    assert inside.sum() >= 12  # of 17; fewer in 1 of 1e4
    # 1.96 sigma of 2.5 % to either side.
    np.testing.assert_allclose((high - low) / rms, 2 * 1.96 / np.sqrt(4 * 396), rtol=0.05)


def test_a_larger_calibration_errs_less_and_all_its_shots_count_as_one(by_law):
    study = by_law[0]["calibration size"]
    np.testing.assert_allclose(
        study.predicted_m**2, 1 / study.values, rtol=1e-3
    )  # the shots' own is a thousandth of it
    # Three calibrations of a size: their mean square is a third of a chi-square of three degrees of freedom.
    ratio = study.position_rms_m / study.predicted_m
    assert ((ratio > 0.01) & (ratio < 3.0)).all()
    assert (study.high_m / study.low_m > 2).all()


def test_rendered_shots_are_measured_as_well_as_predicted():
    """One shot of every setup, rendered and measured as it is: the line from a setup to a study is whole."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "_calibration_study", lambda *arguments: None)
        found = vision_studies(seed=3, shots=1)[:-1]
    for study in found:
        assert not study.missed.any()
        assert (np.sign(POWERS[study.name]) * np.diff(study.predicted_m) > 0).all()
        # One shot: |error|^2 is at most chi-square of three degrees of freedom, 5.54^2 in 1 of 1e6, times the variance.
        assert (study.position_rms_m < 5.54 * study.predicted_m).all()


@pytest.mark.parametrize("interrupted", [False, True])
def test_vision_is_studied_in_a_process_beside_the_rates(monkeypatch, tmp_path, interrupted):
    def rate_study(*given):
        if interrupted:
            raise KeyboardInterrupt
        return "rate"

    monkeypatch.setattr(demo, "vision_studies", dict)  # returns what it is asked for
    monkeypatch.setattr(demo, "rate_study", rate_study)
    whole = SimpleNamespace(closed_s=(0.0, 1.0), ended_text=None)
    given = (Demo(tmp_path, seed=3), "1280x720@60", None, whole, 8, lambda line: None)
    if interrupted:  # the other process is in the middle of an hour, for which nobody waits
        monkeypatch.setattr(demo, "partial", lambda function, **options: functools.partial(time.sleep, 3600))
        with pytest.raises(KeyboardInterrupt):
            demo._studies(*given)
    else:
        assert demo._studies(*given) == ["seed", "shots", "rate"]
