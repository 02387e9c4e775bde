"""Notes of what a health monitor finds, at the moments at which something changes."""

from dataclasses import replace

import pytest

from armsight.loop.finding import HealthFinding
from armsight.loop.running.data import HealthNotes

ROTATED = HealthFinding(
    "rig", "the right camera is rotated by 0.02 deg", 3.0, 0.02, 0.001, "deg", "calibrate", cost_mm=0.5
)


def texts(notes, *findings):
    """Return level, first words and findings of each note."""
    return [(each.level, each.text[:16], each.findings) for each in notes.of(5.0, findings)]


@pytest.fixture
def notes():
    return HealthNotes()


def test_a_finding_is_noted_when_it_begins_and_when_it_is_taken_back(notes):
    line = ROTATED.line()
    assert texts(notes, ROTATED) == [("warning", "rig: the right c", (line,))]
    assert texts(notes, replace(ROTATED, what="the right camera is rotated by 0.03 deg", size=0.03)) == []
    assert texts(notes) == [("info", "no longer found:", ())]


def test_one_that_becomes_worse_is_a_warning_then(notes):
    mild = replace(ROTATED, cost_mm=0.01)
    assert texts(notes, mild) == [("info", "rig: the right c", ())]
    assert texts(notes, ROTATED) == [("warning", "rig: the right c", (ROTATED.line(),))]


def test_one_that_is_put_right_holds_no_longer(notes):
    texts(notes, ROTATED)
    assert texts(notes, replace(ROTATED, corrected_s=6.0)) == [("info", "rig: the right c", ())]


def test_two_of_one_cause_are_two(notes):
    other = replace(ROTATED, what="the left camera is rotated by 0.01 deg")
    assert len(texts(notes, ROTATED, other)) == 2


def test_a_count_or_a_size_that_changes_is_no_other_finding(notes):
    repeats = replace(ROTATED, cause="host", what="99 of 133 shots repeat the one before")
    larger = replace(ROTATED, cause="body", what="the body looks 1.24 % larger")
    assert len(texts(notes, repeats, larger)) == 2
    again = (
        replace(repeats, what="101 of 135 shots repeat the one before"),
        replace(larger, what="the body looks 1.26 % larger"),
    )
    assert texts(notes, *again) == []
    assert replace(ROTATED, what="joint 2 slipped").subject != replace(ROTATED, what="joint 3 slipped").subject
