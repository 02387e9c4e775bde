"""What a run is called: good only where the closed loop is better in all, and nothing is wrong any more."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from armsight.app.run.report import assess
from armsight.loop.finding import HealthFinding

FOUND = HealthFinding("rig", "a camera moved", 1.0, 0.1, 0.01, "deg", "fasten it", cost_mm=1.0)


def run(health=()):
    log = SimpleNamespace(counts=lambda: {"measured": 100, "missed": 0, "rejected": 0})
    found = SimpleNamespace(held_out=SimpleNamespace(rms=lambda: (1e-3, 1e-3)))
    return SimpleNamespace(health=health, ended_text=None, handeye=SimpleNamespace(found=found), log=log)


@pytest.mark.parametrize(
    ("path_mm", "rest_mm", "grade"),
    [((5, 1), (1, 0.5), "good"), ((1, 5), (1, 0.5), "fair"), ((5, 1), (0.5, 1), "fair")],
)
def test_a_run_is_good_where_path_and_rests_are_better(path_mm, rest_mm, grade):
    passes = tuple(SimpleNamespace(path_m=1e-3 * path_mm[k], rest_m=1e-3 * rest_mm[k]) for k in (0, 1))
    found, sentence = assess(run(), passes)
    assert found == grade
    assert f"{path_mm[1]:.2f} mm off, without {path_mm[0]:.2f}" in sentence
    assert f"{rest_mm[1]:.2f} mm off, without {rest_mm[0]:.2f}" in sentence


@pytest.mark.parametrize(("corrected_s", "grade"), [(None, "poor"), (2.0, "fair")])
def test_what_was_put_right_forbids_the_run_no_more(corrected_s, grade):
    assert assess(run((replace(FOUND, corrected_s=corrected_s),)), None)[0] == grade
