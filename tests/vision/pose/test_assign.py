import numpy as np
import pytest

from armsight.geometry.pose import inverse, log_se3, transform
from armsight.vision.detections import SeenShot
from armsight.vision.pose.assign import instances, plain
from strategies import ordinary_rig
from views import both_pixels, somewhere

SIGMA = 0.2


def ball(n=14):
    k = np.arange(n) + 0.5
    z, rotation = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    return 0.04 * np.column_stack([np.sqrt(1 - z**2) * np.cos(rotation), np.sqrt(1 - z**2) * np.sin(rotation), z])


def shot_of(rig, points, Ts, rng):
    """All points of bodies at poses Ts, seen by both cameras in a random order, and which body each is of."""
    uv = [both_pixels(rig, transform(T, points)) + SIGMA * rng.normal(size=(len(points), 2, 2)) for T in Ts]
    ids = np.tile(np.arange(len(points)), len(Ts))
    owner = np.repeat(np.arange(len(Ts)), len(points))
    orders = [rng.permutation(len(ids)) for _ in "lr"]
    positions = [np.concatenate([u[:, side] for u in uv]) for side in (0, 1)]
    shot = SeenShot("1", tuple(ids[o] for o in orders), tuple(p[o] for p, o in zip(positions, orders, strict=True)))
    return shot, [owner[o] for o in orders]


def test_names_that_stand_once_are_plain():
    rig, points, rng = ordinary_rig(), ball(), np.random.default_rng(0)
    shot, _ = shot_of(rig, points, [somewhere(rng)], rng)
    seen = plain(shot)
    assert seen.ids.tolist() == list(range(len(points)))
    assert seen.paired.all()
    for side in (0, 1):
        order = np.argsort(shot.ids[side])
        assert (seen.uv[:, side] == shot.uv[side][order]).all()
    twice, _ = shot_of(rig, points, [somewhere(rng), somewhere(rng)], rng)
    assert plain(twice) is None


@pytest.mark.parametrize("model", ["brown5", "fisheye"])
@pytest.mark.parametrize("seed", range(3))
def test_bodies_take_their_own_detections_and_none_twice(model, seed):
    rig, points, rng = ordinary_rig(model), ball(), np.random.default_rng(seed)
    Ts = [somewhere(rng, middle=(x, 0.0, 0.6), spread=(0.02, 0.05, 0.05)) for x in (-0.05, 0.25)]
    shot, _ = shot_of(rig, points, Ts, rng)
    found = instances(points, rig, shot)
    assert len(found) == 2
    used = [set(), set()]
    taken = set()
    for T, seen in found:
        which = int(np.argmin([np.linalg.norm(T[:3, 3] - other[:3, 3]) for other in Ts]))
        taken.add(which)
        # 0.2 px at 500 px and more and 0.65 m is 0.26 mm across and, on 0.22 m, 1 mm in depth, for one point.
        assert np.linalg.norm(log_se3(inverse(T) @ Ts[which])[:3]) < 1e-3
        assert seen.seen.sum() == 2 * len(points)
        for side in (0, 1):
            mine = {tuple(p) for p in seen.uv[:, side]}
            assert not mine & used[side]
            used[side] |= mine
    assert taken == {0, 1}


def test_a_wrong_name_is_left_out():
    rig, points, rng = ordinary_rig(), ball(), np.random.default_rng(5)
    shot, _ = shot_of(rig, points, [somewhere(rng)], rng)
    ids = np.array(shot.ids[0])
    a, b = (int(np.flatnonzero(ids == n)[0]) for n in (0, 13))  # opposite ends of the ball
    ids[[a, b]] = ids[[b, a]]
    ((_, seen),) = instances(points, rig, SeenShot("1", (ids, shot.ids[1]), shot.uv))
    assert not seen.seen[[0, 13], 0].any()
    assert seen.seen[:, 1].all()
    assert seen.seen[1:13].all()


def test_nothing_is_no_body():
    rig, points = ordinary_rig(), ball()
    nothing = SeenShot("1", (np.zeros(0, np.int64),) * 2, (np.zeros((0, 2)),) * 2)
    assert instances(points, rig, nothing) == []
    assert plain(nothing).ids.size == 0
