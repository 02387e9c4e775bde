"""A point followed by ranges: biases, and a wall that makes some far too long."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from armsight.data import Array
from armsight.loop.references.distance import Distance, RangeNoise, follow_ranges

ANCHORS = np.array([[0.0, 0.0, 0.5], [6.0, 0.5, 2.0], [5.5, 6.0, 0.4], [-0.5, 5.5, 1.9]])


SENSOR = Distance(name="uwb", cov=np.eye(23), anchors=ANCHORS, p_tool=np.zeros(3), offset=np.zeros(4), scale=np.ones(4))


def _drive(seed: int, walled: float, shared: bool = False) -> tuple[Array, Array, Array, Array]:
    """Return times, anchors, ranges and truth of 40 s; the errors are not those that the smoother assumes."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0.0, 40.0, 800))
    truth = np.column_stack([3 + 2 * np.sin(0.3 * t), 3 + 2 * np.sin(0.43 * t), np.full(len(t), 0.3)])
    truth[:, :2] += 4.0 * shared  # to one side of the anchors, where such a bias does not cancel
    channel = rng.integers(0, 4, len(t))
    bias = 0.15 * np.sin(0.12 * t + 1.7 * channel * (not shared) + seed)
    z = np.linalg.norm(truth - ANCHORS[channel], axis=1) + bias + 0.07 * rng.standard_t(4, len(t))
    return t, channel, np.where(rng.random(len(t)) < walled, z + rng.exponential(1.0, len(t)), z), truth


def test_walls_and_biases_cost_less_than_in_least_squares() -> None:
    for seed, walled in ((1, 0.0), (2, 0.15)):
        t, channel, z, truth = _drive(seed, walled)
        path = follow_ranges(SENSOR, t, channel, z, np.array([3.0, 3.0, 0.5]))
        e = (path.p - truth)[100:, :2]
        plain = []
        for k in range(100, len(t), 10):
            rows = [np.flatnonzero(channel[: k + 1] == c)[-1] for c in range(4)]

            def off(v: Array, read: Array = z[rows]) -> Array:
                return np.asarray(np.linalg.norm(v - ANCHORS, axis=1) - read)

            plain.append(np.linalg.norm((least_squares(off, truth[k]).x - truth[k])[:2]))
        rms = float(np.sqrt((e**2).sum(axis=1).mean()))
        assert rms < 0.7 * float(np.sqrt(np.mean(np.square(plain))))
        squares = np.einsum("ni,nij,nj->n", e, np.linalg.inv(path.cov[100:, :2, :2]), e)
        assert (squares < 5.99).mean() > 0.8  # 95 % where its model holds


def test_a_bias_that_all_ranges_share_is_in_the_regions() -> None:
    squares = []
    for seed in (21, 22, 23):
        t, channel, z, truth = _drive(seed, 0.0, shared=True)
        path = follow_ranges(SENSOR, t, channel, z, truth[0], RangeNoise(bias_m=0.02, common_m=0.1))
        e = (path.p - truth)[100:, :2]
        squares.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(path.cov[100:, :2, :2]), e))
    assert (np.array(squares) < 5.99).mean() > 0.93  # 51 to 63 % without
    assert 0.3 < np.mean(squares) / 2 < 1.2
