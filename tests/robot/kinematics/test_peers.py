"""The arm against pinocchio (poses, Jacobians and their rates) and EAIK (every solution of the inverse)."""

import sys

import arms
import numpy as np
import peers
import pytest

models = pytest.mark.parametrize("arm", [*arms.CLOSED.values()], ids=[*arms.CLOSED])


def draw(seed, n):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (n, 6))


@models
@pytest.mark.skipif(sys.platform == "win32", reason="pinocchio has no wheels for Windows")
def test_pinocchio_has_the_same_pose_jacobian_and_rate(arm):
    peer = peers.Pinocchio(arm)
    for q, qd in zip(draw(1, 30), draw(2, 30), strict=True):
        np.testing.assert_allclose(arm.forward(q), peer.forward(q), rtol=0, atol=1e-14)
        for frame in ("base", "tool"):
            np.testing.assert_allclose(arm.jacobian(q, frame), peer.jacobian(q, frame), rtol=0, atol=1e-14)
            # speeds of up to pi rad/s on all joints: 20 times larger numbers
            rate = peer.jacobian_rate(q, qd, frame)
            np.testing.assert_allclose(arm.jacobian_rate(q, qd, frame), rate, rtol=0, atol=2e-13)


@models
def test_no_solution_is_missed_that_eaik_finds(arm):
    peer = peers.Eaik(arm)
    missed = found = ours = 0
    for q in draw(4, 200):
        T = arm.forward(q)
        theirs, answer = peer.inverse(T), arm.inverse(T)
        missed += len(peers.unmatched(arm, T, theirs, answer))
        found, ours = found + len(theirs), ours + len(answer)
    assert missed == 0
    assert ours >= found > 800


@models
def test_near_singularities_what_eaik_finds_is_found_too(arm):
    peer, found, missed = peers.Eaik(arm), 0, 0
    for q in arms.near_singular(arm, 200, np.random.default_rng(5)):
        T = arm.forward(q)
        theirs = peer.inverse(T)
        theirs = theirs[np.max(arms.off(arm.forward(theirs), T), axis=0) < 1e-9] if len(theirs) else theirs
        found += len(theirs)
        for other in peers.unmatched(arm, T, theirs, arm.inverse(T)):
            # On a singularity joint angles are a family of which each returns a few; asked for, theirs is ours too.
            assert np.linalg.svd(arm.jacobian(other))[1][-1] < 1e-5
            missed += len(peers.unmatched(arm, T, [other], arm.inverse(T, near=other)))
    assert missed <= 1e-3 * found  # wrist, elbow and shoulder singular at once: what rounding leaves of it is a lottery
