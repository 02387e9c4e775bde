"""Choosing poses."""

import numpy as np

from armsight.loop.identify.plan import exchanged


def test_exchange_makes_a_choice_better_and_keeps_to_what_is_allowed():
    """One unknown a joint, shown by the joint's own angle: the best poses lie at the limits, whatever the start."""
    rng = np.random.default_rng(4)

    def information(q, approach):
        return (q * approach)[:, None, :], q[:, 0] <= 0.5

    start, sides = rng.uniform(-0.3, 0.3, (8, 6)), np.ones((8, 6))
    requested = np.vstack([np.eye(6)] * 3)
    limits = np.full(6, -1.0), np.ones(6)
    q, approach = exchanged(start, sides, information, np.eye(6), requested, limits, rng)
    H = np.eye(6) + np.einsum("nki,nkj->ij", *[information(q, approach)[0]] * 2)
    first = np.eye(6) + np.einsum("nki,nkj->ij", *[information(start, sides)[0]] * 2)
    assert np.trace(np.linalg.inv(H)) < 0.5 * np.trace(np.linalg.inv(first))
    assert (np.abs(q) <= 1).all()
    assert (q[:, 0] <= 0.5).all()
