"""Changes of rig, body and joints that a filter would follow: found by closure, named, sized; none where none is."""

from functools import partial

import faults
import numpy as np
import pytest
from arm_rig import ARM
from scipy.special import chdtri

from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.estimators import Innovation, Outcome, PoseMeasurement, Prior
from armsight.loop.estimators.armerror import layout
from armsight.loop.estimators.errormodel import ErrorModel
from armsight.loop.health import HealthMonitor
from armsight.loop.health.change import ToolView, finding
from armsight.loop.health.closure import ClosureWatch
from armsight.loop.servo import Mode

SHOT_S, AT_S, PRIOR = 0.1, 18.0, Prior()
SHOT = np.repeat([1.5e-4, np.radians(0.02)], 3)
PARTS = layout(6)
COLUMNS = {"rig": slice(0, 6), "drift": slice(0, 6), "body": slice(36, 42)}


def watched(seed, kind=None, size=0.0, joint=0, seconds=45.0, lasts_s=np.inf):
    """A watch of a moving arm in the filter's own model; a change begins at AT_S and lasts so long."""
    rng = np.random.default_rng(seed)
    watch = ClosureWatch(PRIOR.sigmas(0.0), ARM.joints)
    model = ErrorModel(ARM, PRIOR, 0.0)
    x = PRIOR.sigmas(0.0) * rng.normal(size=PARTS.size)
    x[102:] = 0.0
    rates, phases = rng.uniform(0.1, 0.3, 6), rng.uniform(0.0, 2 * np.pi, 6)
    kept = np.ones(PARTS.size)
    kept[PARTS.pose :] = np.exp(-0.05)
    for k in range(round(seconds / SHOT_S)):
        t_s = k * SHOT_S
        angle = 2 * np.pi * rates * t_s + phases
        q = ARM.home + 0.5 * np.sin(angle)
        unseen = np.zeros((1, 3, 6))
        unseen[0, 0] = unseen[0, 1] = np.sign(np.cos(angle))
        (T,), (H,) = model.poses(np.zeros((1, PARTS.size)), q[None], unseen)
        e = H @ x + SHOT * rng.normal(size=6)
        if kind is not None and AT_S <= t_s < AT_S + lasts_s:
            if kind == "bend":
                down = T[:3, :3].T @ [0.0, 0.0, -1.0]
                column = np.vstack([np.column_stack([np.zeros((3, 3)), down]), np.eye(3, 4)])
                column[3:, :3] = np.cross(np.eye(3), down).T
            elif kind == "backlash":
                column = 0.5 * (H[:, [PARTS.backlash + joint]] + H[:, [PARTS.floats + joint]])
            else:
                column = H[:, COLUMNS.get(kind, [PARTS.zeros[joint]])]
            e += column @ np.atleast_1d(size) * ((t_s - AT_S) if kind == "drift" else 1.0)
        none = np.zeros((PARTS.size, 6))
        reference = partial(tuple, (e, H))
        watch.take([Innovation(t_s, T, e, np.diag(SHOT**2), H, kept, none, Outcome.USED, None, reference)])
    return watch


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_found_where_nothing_changes(seed):
    watch = watched(seed, seconds=60.0)
    assert watch.changes == ()
    assert watch.strongest < 1.0


@pytest.mark.parametrize("deg", [0.2, 0.3])
def test_a_side_of_the_backlash_that_is_wrong_for_two_blocks_is_no_slip(deg):
    watch = watched(11, "joint", np.radians(deg), 5, AT_S + 1.7, lasts_s=1.4)
    assert watch.explained  # for another test that notices something
    assert watch.changes == ()


def test_what_explained_something_once_and_does_no_more_is_taken_back():
    once, watch = watched(11, "bend", np.radians([0.04, 0.0, 0.0, 0.0])), watched(11)
    assert once.certain
    watch.explained, watch.certain = once.explained, once.certain
    watch._decide()  # finds nothing
    assert watch.explained == watch.certain == ()
    once._unsure = dict.fromkeys(once._unsure, 1e9)
    once._decide()
    assert once.explained
    assert once.certain == ()  # it widens no pose


SHIFT = np.array([6e-4, 0.0, 3e-4, 0.0, np.radians(0.03), 0.0])


@pytest.mark.parametrize(
    ("kind", "size", "joint", "cause"),
    [
        ("rig", SHIFT, 0, "fixed"),
        ("drift", SHIFT / 20.0, 0, "fixed"),
        ("body", 2.0 * SHIFT, 0, "body"),
        ("bend", np.radians([0.1, -0.05, 0.0, 0.0]), 0, "body"),
        ("joint", np.radians(0.5), 2, "joint"),
        ("joint", np.radians(-0.5), 1, "joint"),
        ("backlash", np.radians(0.5), 1, "joint"),
    ],
)
def test_a_change_is_named_sized_and_dated(kind, size, joint, cause):
    watch = watched(11, kind, size, joint)
    found, change = finding(watch.changes, ARM.joint_names), watch.changes[0]
    assert (found.cause, change.suspect.kind) == (cause, kind)
    if cause == "joint":
        assert change.suspect.joint == joint
        assert ARM.joint_names[joint] in found.what
    assert found.since_s == pytest.approx(AT_S, abs=4.0)
    factor = (45.0 - AT_S) if kind == "drift" else 1.0
    off = change.size - factor * np.atleast_1d(size)
    if abs(found.since_s - AT_S) < 0.8 or kind != "drift":
        assert off @ np.linalg.solve(change.cov, off) < 25.0


def test_what_is_kept_is_bounded_and_old_changes_stay_found(monkeypatch):
    monkeypatch.setattr("armsight.loop.health.closure._MOST_KEPT", 80)
    watch = watched(11, "rig", SHIFT, seconds=180.0)
    assert sum(watch._merged) > 200
    assert len(watch._t) < 80
    assert [len(each) for each in (watch._e, watch._H, watch._merged, watch._sums)] == 4 * [len(watch._t)]
    found, change = finding(watch.changes, ARM.joint_names), watch.changes[0]
    assert (found.cause, change.suspect.kind) == ("fixed", "rig")
    assert found.since_s == pytest.approx(AT_S, abs=4.0)
    off = change.size - SHIFT
    assert off @ np.linalg.solve(change.cov, off) < chdtri(6, 1e-3)
    assert watched(3, seconds=100.0).changes == ()


def test_the_first_joint_looks_like_a_rotation_of_the_rig_about_its_axis():
    found = finding(watched(12, "joint", np.radians(0.5), 0).changes, ARM.joint_names)
    assert "fixed" in found.alternatives
    assert "or the rig rotated about the axis of this joint" in found.what


def test_sizes_scatter_as_their_covariance_says():
    """Mean of the normalised error squared, of 6 freedoms; the beginnings that are tried are coarse."""
    squares = []
    for seed in range(20, 24):
        change = watched(seed, "rig", SHIFT, seconds=40.0).changes[0]
        assert change.suspect.kind == "rig"
        off = change.size - SHIFT
        squares.append(off @ np.linalg.solve(change.cov, off))
    assert np.mean(squares) < 12.0


def test_a_loop_on_a_rig_that_moved_is_no_worse_than_the_potentiometers(monkeypatch):
    monkeypatch.setattr(faults, "LEARNED_S", 3.0)
    monkeypatch.setattr(faults, "AT_S", 4.0)
    alone = max(row[1] for row in faults.closed_loop(40, closes=False, seconds=9.0)[0])
    rows, _ = faults.closed_loop(40, lambda t_s: np.array([0.01, 0.0, 0.0, 0.0, np.radians(0.8), 0.0]), seconds=9.0)
    assert max(distance for t_s, distance, *_ in rows if t_s > 4.0) < 1.2 * alone
    # What was learned of the arm before is still true of it.
    assert max(distance for t_s, distance, rests, _ in rows if rests and t_s > 5.0) < 0.3 * alone
    assert rows[-1][3] is Mode.DISTRUSTED
    assert any(mode is Mode.VISION for *_, mode in rows)


def test_a_bumped_rig_is_put_right_within_ten_seconds(monkeypatch):
    monkeypatch.setattr(faults, "LEARNED_S", 5.0)
    monkeypatch.setattr(faults, "AT_S", 10.0)
    bump = np.array([0.002, 0.0, 0.0, 0.0, 0.0, 0.0])
    _, made = faults.closed_loop(5540, lambda t_s: bump, follows=True, seconds=20.0)
    assert made[0].at_s - faults.AT_S < 10.0
    for each in made:
        assert abs(each.tool_m[0] - 0.002) < 3.0 * each.tool_m[1]


def test_focal_lengths_that_changed_alike_are_named(monkeypatch):
    monkeypatch.setattr(faults, "AT_S", 10.0)
    share = 1e-3
    moved = faults.watched_arm(7411, seconds=30.0, zoom=lambda t_s: share)
    (found,) = moved.monitor.findings()
    assert "lens" in (found.cause, *found.alternatives)
    (zoom,) = (each for each in moved.monitor.changes if each.suspect.kind == "zoom")
    assert abs(zoom.size[0] - share) < 4 * np.sqrt(zoom.cov[0, 0]) < share
    rows = np.flatnonzero(moved.tracked.t_s > moved.found_s + 1.0)[::50]
    off = faults.log_se3(faults.inverse(moved.tracked.Ts_base_tool[rows]) @ moved.Ts_true[rows])
    assert np.mean(np.einsum("ni,ni->n", off, np.linalg.solve(moved.tracked.covs[rows], off[..., None])[..., 0])) < 12.0


def test_what_a_zoom_does_to_a_pose_is_what_larger_images_show():
    """Against poses fitted to pixels, which weigh depth less than points do and so rotate less: to 8 % of the shift."""
    seen, rng = ToolView(np.eye(4), faults.BODY.points), np.random.default_rng(7413)
    for _ in range(5):
        T = pose(exp_so3(rng.uniform(-0.6, 0.6, 3)), np.array([0.1, 0.0, 0.9]) + rng.uniform(-0.1, 0.1, 3))
        shown = faults.log_se3(faults.inverse(T) @ faults.Moved.zoomed(T, 1.001))
        (expected,) = seen.zoomed(T[None, :3, :3], T[None, :3, 3]) * 1e-3
        assert np.linalg.norm((expected - shown)[:3]) < 0.08 * np.linalg.norm(shown[:3])
        assert np.linalg.norm((expected - shown)[3:]) < 5e-4


def test_a_change_that_is_certain_but_too_small_to_be_reported_widens_poses():
    watch, monitor = (
        watched(11, "bend", np.radians([0.04, 0.0, 0.0, 0.0])),
        HealthMonitor(faults.TRUE, faults.BODY, 0.0),
    )
    pose_seen = PoseMeasurement(44.0, ARM.forward(ARM.home), 1e-10 * np.eye(6), np.zeros((6, 6)))
    assert monitor.suspected(pose_seen) is None
    monitor._closure = watch
    assert (watch.changes, monitor.findings()) == ((), ())
    down = ARM.forward(ARM.home)[:3, :3].T @ [0.0, 0.0, -1.0]
    off = np.append(np.zeros(3), np.radians(0.04) * np.cross([1.0, 0.0, 0.0], down))
    assert 0.1 < off @ np.linalg.solve(monitor.suspected(pose_seen), off) < 12.0
