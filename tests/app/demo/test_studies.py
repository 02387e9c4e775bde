"""The studies of vision: the measured errors agree with the predicted ones, which follow the geometry."""

import numpy as np
import pytest
from scipy.stats import chi2

from armsight.app.demo import studies
from armsight.app.demo.studies import vision_studies

SHOTS = 3


@pytest.fixture(scope="module")
def found():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studies, "_REPEATS", 1)
        said = []
        yield {study.name: study for study in vision_studies(seed=3, shots=SHOTS, progress=said.append)}, said


def test_every_study_is_reported_and_misses_nothing(found):
    by_name, said = found
    assert list(by_name) == ["distance", "baseline", "image width", "pixel noise", "calibration size"]
    for study in by_name.values():
        assert not study.missed.any()
        assert (study.low_m < study.position_rms_m).all()
        assert (study.position_rms_m < study.high_m).all()
    assert all(any(name in line for line in said) for name in ("distance", "baseline", "32 pairs"))


@pytest.mark.parametrize(
    ("name", "way"),
    [("distance", 1), ("baseline", -1), ("image width", -1), ("pixel noise", 1), ("calibration size", -1)],
)
def test_predicted_errors_follow_the_geometry(found, name, way):
    assert (way * np.diff(found[0][name].predicted_m) > 0).all()


@pytest.mark.parametrize("name", ["distance", "baseline", "image width", "pixel noise"])
def test_measured_errors_agree_with_predicted_ones(found, name):
    study = found[0][name]
    # Most of the error is along the line of sight: so many shots are as many squares at least, 17 values in 1e4 runs.
    ratio = (study.position_rms_m / study.predicted_m) ** 2
    low, high = chi2.ppf([0.5e-4 / 17, 1 - 0.5e-4 / 17], SHOTS) / SHOTS
    assert (ratio > low).all()
    assert (ratio < high).all()
