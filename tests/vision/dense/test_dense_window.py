"""Windows' totals and winners against their definitions."""

import numpy as np
import pytest
from dense_scenes import at, layers, raw_costs

from armsight.vision.dense.block import REACH, Block
from armsight.vision.dense.method import Search


def totals(raw, reach):
    height, width, _ = raw.shape
    rows = np.clip(np.arange(height)[:, None] + np.arange(-reach, reach + 1), 0, height - 1)
    columns = np.clip(np.arange(width)[:, None] + np.arange(-reach, reach + 1), 0, width - 1)
    return raw[rows].sum(axis=1)[:, columns].sum(axis=2)


@pytest.mark.parametrize("first", [0, 3])
def test_totals_winners_and_agreement_are_those_of_the_definition(first):
    left, right, _ = layers(noise=3.0)
    left, right = np.ascontiguousarray(left[30:54, 60:110]), np.ascontiguousarray(right[30:54, 60:110])
    count = 10

    def cost(differ, y, x, d):
        """Twice the census bits that differ and half of the absolute difference."""
        return 2 * differ + min(abs(at(left, y, x) - at(right, y, x - d)), 20) // 2

    total = totals(raw_costs(left, right, Search(first, count), (-2, 0, 2), 10, cost), REACH)
    height, width, _ = total.shape
    d = first + np.arange(count)
    total[:, d[None, :] > np.arange(width)[:, None]] = 10**6
    found = Block().search(left, right, Search(first, count))
    inside = np.arange(width) >= first
    winner = total.argmin(axis=2)
    np.testing.assert_array_equal(found.least[:, inside], total.min(axis=2)[:, inside])
    assert (np.abs(found.disparity - first - winner) <= 0.5)[:, inside].all()
    assert not found.agreed[:, ~inside].any()
    best_right = np.full((height, width), 10**6)
    for k in range(count):
        u = np.arange(first + k, width)
        best_right[:, u - first - k] = np.minimum(best_right[:, u - first - k], total[:, u, k])
    for y in range(height):
        for x in range(first, width):
            k = winner[y, x]
            near = [(x + s, k + s) for s in (-1, 0, 1) if 0 <= x + s < width and 0 <= k + s < count]
            agreed = min(total[y, u, j] for u, j in near) <= best_right[y, x - first - k]
            assert found.agreed[y, x] == agreed


def test_no_sum_leaves_its_type():
    checks = np.where(np.indices((60, 80)).sum(axis=0) % 4 < 2, 0, 255).astype(np.uint8)
    found = Block().search(checks, np.roll(checks, 2, axis=1).copy(), Search(0, 2))
    most = 2 * 8 + 20 // 2  # of one match
    assert most * (2 * REACH + 1) < 256
    assert found.least.max() <= most * (2 * REACH + 1) ** 2 < 65536
