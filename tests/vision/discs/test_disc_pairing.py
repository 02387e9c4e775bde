"""Pairs of uncoded discs against trying every pair, and triples against trying every triple."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armsight.data import Discs
from armsight.geometry.pose import transform
from armsight.vision.discs.identify import DISTANCE_SIGMAS, triples
from armsight.vision.discs.pairing import DEPTHS_M, GATE_SIGMAS, MOST_PAIRS, SIZE_TOLERANCE, DiscView, pair
from armsight.vision.triangulate import optimal_points
from disc_views import PLATE, discs_of, hd_rig, someplace, views
from strategies import ordinary_rig
from views import both_pixels

MIXED = discs_of([[0, 0, 0], [0.06, 0, 0], [0.02, 0.05, 0.01], [-0.04, 0.03, 0]], radius=[0.006, 0.006, 0.008, 0.01])


def every_pair(view):
    """Chi-square of the rays' meeting, distance z and ratio of seen to expected size of every pair there is."""
    left, right = view.discs
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(len(left.uv)), np.arange(len(right.uv)), indexing="ij"))
    uv = np.stack([left.uv[i], right.uv[j]], axis=1)
    cov = np.stack([view.cov_uv[0][i], view.cov_uv[1][j]], axis=1)
    p, _, _ = optimal_points(view.rig, uv, cov)
    good = np.isfinite(p).all(axis=1)
    gap = uv[good] - both_pixels(view.rig, p[good])
    chi2 = np.full(len(i), np.inf)
    chi2[good] = np.einsum("nci,ncij,ncj->n", gap, np.linalg.inv(cov[good]), gap)
    return i, j, chi2, p


@pytest.mark.parametrize("seed", range(4))
def test_pairs_are_those_of_trying_every_one(seed):
    rig, rng = hd_rig(known=True), np.random.default_rng(seed)
    target = replace(MIXED, bright=np.array([True, True, False, True]))
    left, right, owner = views(rig, target, [someplace(rng)], rng, clutter=60)
    view = DiscView.of(rig, target, left, right)
    found = pair(view)
    got = set(zip(found.left.tolist(), found.right.tolist(), strict=True))
    i, j, chi2, p = every_pair(view)
    f = 900.0
    for a, b, c, at in zip(i.tolist(), j.tolist(), chi2, p, strict=True):
        if not c < 1.1 * GATE_SIGMAS**2 or left.bright[a] != right.bright[b]:
            assert (a, b) not in got
            continue
        # A disc's longer half axis is its radius over its distance, scaled towards the corner by a fifth at most.
        ratio = np.array([left.radius_px[a], right.radius_px[b]]) * at[2] / f
        kinds = target.radii_m[target.bright == left.bright[a]]
        surely = ((ratio[:, None] > 1.05 * (1 - SIZE_TOLERANCE) * kinds) & (ratio[:, None] < kinds)).all(axis=0).any()
        maybe = ((ratio[:, None] > 0.7 * kinds) & (ratio[:, None] < 1.6 * kinds)).all(axis=0).any()
        deep = DEPTHS_M[0] < at[2] < DEPTHS_M[1]
        assert maybe or (a, b) not in got
        if c < 0.9 * GATE_SIGMAS**2 and surely and deep:
            assert (a, b) in got
    here = [
        (n, m)
        for n in range(len(left.uv))
        for m in range(len(right.uv))
        if owner[0][n][0] == 0 and (owner[0][n] == owner[1][m]).all()
    ]
    assert set(here) <= got
    for n, m in here:
        row = np.flatnonzero((found.left == n) & (found.right == m))[0]
        assert found.fits[row, owner[0][n][1]]


@pytest.mark.parametrize("model", ["none", "brown5", "brown8", "fisheye"])
def test_true_pairs_are_found_through_any_lens_and_with_a_rig_that_is_badly_known(model):
    known, rng = ordinary_rig(model), np.random.default_rng(1)
    root = np.linalg.cholesky(known.cov + 1e-20 * np.eye(len(known.cov))) * 0.3
    rig = replace(known, cov=root @ root.T)
    for _ in range(20):
        true = rig.perturbed(root @ rng.normal(size=len(root)))
        T = someplace(rng, z=(0.5, 0.9))
        left, right, owner = views(true, MIXED, [T], rng, clutter=20)
        found = pair(DiscView.of(rig, MIXED, left, right))
        got = set(zip(found.left.tolist(), found.right.tolist(), strict=True))
        for n, mine in enumerate(owner[0].tolist()):
            for m, theirs in enumerate(owner[1].tolist()):
                if mine[0] == 0 and mine == theirs:
                    assert (n, m) in got


def test_what_pairs_say_of_their_position_is_true():
    """A pair's position is off by its covariance and the rig's: mean normalised square over 100 views of 4 discs."""
    rig, nees = hd_rig(), []
    root = np.linalg.cholesky(rig.cov)
    for seed in range(100):
        rng = np.random.default_rng(seed)
        T = someplace(rng)
        # Noise as large as what is allowed for: 0.1 px beside the discs' own.
        left, right, owner = views(rig.perturbed(root @ rng.normal(size=22)), MIXED, [T], rng, sigma=0.1)
        quiet = [Discs(d.uv, 0 * d.cov_uv, d.shape, d.bright) for d in (left, right)]
        found = pair(DiscView.of(rig, MIXED, *quiet))
        p = transform(T, MIXED.body.points)
        for n, (a, b) in enumerate(zip(found.left, found.right, strict=True)):
            if (owner[0][a] == owner[1][b]).all():
                e = found.p_left[n] - p[owner[0][a][1]]
                nees.append(e @ np.linalg.solve(found.cov[n] + found.by_rig[n] @ found.by_rig[n].T, e))
    # Discs of one view share the rig's error: as if every view were one independent triple, 3 of 300 degrees.
    assert abs(np.mean(nees) - 3) < 4 * np.sqrt(2 * 3 / 100)


def test_too_many_pairs_are_reported():
    rig, n = hd_rig(known=True), int(np.sqrt(MOST_PAIRS)) + 20
    rng = np.random.default_rng(0)
    z = rng.uniform(0.8, 0.81, n)
    uv = both_pixels(rig, np.column_stack([rng.uniform(-0.1, 0.3, n), rng.uniform(-0.1, 0.1, n), z]))
    sides = [
        Discs(uv[:, s], np.tile(1e4 * np.eye(2), (n, 1, 1)), np.tile([81.0, 0, 81.0], (n, 1)), np.ones(n, bool))
        for s in (0, 1)
    ]
    assert pair(DiscView.of(rig, PLATE, *sides)) is None


def test_nothing_makes_no_pairs_and_no_triples():
    rig = hd_rig()
    nothing = Discs(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 3)), np.zeros(0, bool))
    view = DiscView.of(rig, PLATE, nothing, nothing)
    pairs = pair(view)
    assert len(pairs.left) == 0
    assert len(triples(view, pairs).ids) == 0


@pytest.mark.parametrize("seed", range(3))
def test_triples_are_those_of_trying_every_one(seed):
    rig, rng = hd_rig(), np.random.default_rng(seed)
    left, right, _ = views(rig, MIXED, [someplace(rng), someplace(rng)], rng, clutter=40)
    view = DiscView.of(rig, MIXED, left, right)
    pairs = pair(view)
    found = triples(view, pairs)
    got = {
        frozenset(zip(ids, rows, strict=True))
        for ids, rows in zip(found.ids.tolist(), found.rows.tolist(), strict=True)
    }
    assert len(got) == len(found.ids)
    p, root = pairs.p_left, pairs.by_rig

    def fit(a, i, b, j):
        if pairs.left[i] == pairs.left[j] or pairs.right[i] == pairs.right[j]:
            return False
        gap, side = p[i] - p[j], np.linalg.norm(MIXED.body.points[a] - MIXED.body.points[b])
        u = gap / np.linalg.norm(gap)
        variance = u @ (pairs.cov[i] + pairs.cov[j]) @ u + ((u @ (root[i] - root[j])) ** 2).sum() + view.made_sigma_m**2
        return (np.linalg.norm(gap) - side) ** 2 <= DISTANCE_SIGMAS**2 * variance

    nodes = [(int(a), int(i)) for i, a in np.argwhere(pairs.fits)]
    want = set()
    for one, two, three in itertools.combinations(nodes, 3):
        if len({one[0], two[0], three[0]}) == 3 and all(
            fit(*x, *y) for x, y in itertools.combinations((one, two, three), 2)
        ):
            want.add(frozenset((one, two, three)))
    assert got == want
    for ids, rows, T in zip(found.ids, found.rows, found.Ts_left_body, strict=True):
        b, a = MIXED.body.points[ids], p[rows]
        R, _ = Rotation.align_vectors(a - a.mean(axis=0), b - b.mean(axis=0))
        np.testing.assert_allclose(T[:3, :3], R.as_matrix(), atol=1e-6)
        np.testing.assert_allclose(transform(T, b).mean(axis=0), a.mean(axis=0), atol=1e-9)
