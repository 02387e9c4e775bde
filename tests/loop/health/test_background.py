"""What the background says: which camera rotated, by how much; people, lamps and walls without texture say nothing."""

import numpy as np
import pytest
from rooms import RATE_HZ, STILL, Room

from armsight.loop.health.scene import SceneWatch

DEG = np.radians(1.0)
BEGINS = 25  # looks before something moves


def watched(room, *, left=STILL, right=STILL, looks=6, after=None, **light):
    """Watch a room; from BEGINS on its cameras have moved, and its light is another."""
    watch = SceneWatch(room.rig)
    for k in range(BEGINS + looks):
        moved = k >= BEGINS
        given = {"left": left, "right": right, **(after or {})} if moved else {}
        watch.take(room.shot(k, **{**light, **given}), k / RATE_HZ)
    return watch


@pytest.fixture(scope="module")
def room():
    return Room(11, scale=0.4)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_camera_that_rotated_is_named_with_its_size(room, side):
    rotated = np.array([0.0, 0.0, 0.0, 0.02 * DEG, 0.0, 0.0])
    watch = watched(room, **{side: rotated}, people=True, quality=85, after={"lamp": 0.3})
    assert min(watch.spots) > 20
    (found,) = watch.findings()
    other = {"left": "right", "right": "left"}[side]
    assert found.cause == "rig"
    assert found.what.startswith(f"the {side} camera rotated by")
    assert f"the {other} one did not" in found.what
    assert found.unit == "deg"
    assert abs(found.size - 0.02) < 3 * found.sigma
    assert found.sigma < 0.004
    assert 0 <= found.since_s - BEGINS / RATE_HZ < 1.0


@pytest.mark.parametrize("axis", [0, 1])
def test_a_camera_that_moved_is_named_with_its_size(room, axis):
    (found,) = watched(room, right=2e-3 * np.eye(6)[axis], looks=10).findings()
    assert found.what.startswith("the right camera moved by")
    assert found.unit == "mm"
    assert abs(found.size - 2.0) < 3 * found.sigma
    assert found.sigma < 0.6


def test_a_camera_that_rotated_sideways_costs_more_than_one_that_nods(room):
    (nods,), (rotates,) = (
        watched(room, right=np.array([0.0, 0, 0, *(0.03 * DEG * axis)])).findings() for axis in np.eye(3)[:2]
    )
    depth = 1.0**2 / room.rig.baseline_m * 0.03 * DEG  # of a point 1 m away, to first order
    assert rotates.cost_mm == pytest.approx(1e3 * depth, rel=0.25)
    assert nods.cost_mm < 0.5 * rotates.cost_mm
    assert rotates.forbids


def test_both_cameras_on_one_stand_that_rotates_are_the_rig(room):
    rotated = np.array([0.0, 0.0, 0.0, 0.0, 0.05 * DEG, 0.0])
    R = room.rig.T_left_right[:3, :3]
    (found,) = watched(room, left=rotated, right=np.append(np.zeros(3), R.T @ rotated[3:])).findings()
    assert found.cause == "fixed"
    assert found.what.startswith("both cameras moved together")


def test_a_camera_that_came_back_forbids_only_what_was_measured_meanwhile(room):
    watch, xi = SceneWatch(room.rig), np.array([0.0, 0.0, 0.0, 0.0, 0.05 * DEG, 0.0])
    for k in range(BEGINS + 16):
        watch.take(room.shot(k, right=xi if BEGINS <= k < BEGINS + 4 else STILL), k / RATE_HZ)
    (found,) = watch.findings()
    assert (BEGINS + 4) / RATE_HZ < found.corrected_s <= (BEGINS + 15) / RATE_HZ


def test_people_a_lamp_and_a_wandering_shadow_are_no_motion(room):
    assert not watched(room, people=True, quality=80, after={"lamp": 0.4}, looks=12).findings()
    watch = SceneWatch(room.rig)
    for k in range(40):
        watch.take(room.shot(k, sun=0.2 + 0.01 * k, people=True), k / RATE_HZ)
    assert not watch.findings()


def test_a_room_without_texture_says_nothing(room):
    bare = Room(11, scale=0.4, texture=False)
    watch = watched(bare, right=np.array([0.0, 0.0, 0.0, 0.0, 0.1 * DEG, 0.0]))
    assert max(watch.spots) < 10
    assert not watch.findings()
