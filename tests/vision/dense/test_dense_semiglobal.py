"""The compiled recurrence against a slow and obvious one."""

import numpy as np
import pytest
from dense_scenes import at, layers, raw_costs

from armsight.vision.dense.cost import _RAW_MAX
from armsight.vision.dense.method import Search
from armsight.vision.dense.semiglobal import _EDGE, _P1, _P2, Semiglobal

WAYS = {
    5: [(0, 1), (0, -1), (1, 0), (1, 1), (1, -1)],
    8: [(0, 1), (0, -1), (1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1)],
}


def birchfield_tomasi(left, right, y, x, d):
    """Return Birchfield and Tomasi's dissimilarity."""

    def span(image, y, x):
        c = at(image, y, x)
        ends = [c, (c + at(image, y, x - 1)) // 2, (c + at(image, y, x + 1)) // 2]
        return c, min(ends), max(ends)

    (a, a_low, a_high), (b, b_low, b_high) = span(left, y, x), span(right, y, x - d)
    return min(max(0, a - b_high, b_low - a), max(0, b - a_high, a_low - b))


def smoothed(raw):
    """Three rows added, then weights 1 2 1 along the row with the roundings of two means."""
    height, width, _ = raw.shape
    rows = np.clip(np.arange(height)[:, None] + [-1, 0, 1], 0, height - 1)
    column = raw[rows].sum(axis=1)
    before, after = (
        column[:, np.clip(np.arange(width) - 1, 0, None)],
        column[:, np.clip(np.arange(width) + 1, None, width - 1)],
    )
    return ((before + after + 1) // 2 + column + 1) // 2


def totals(costs, image, ways):
    """Sum the paths, each by its definition."""
    height, width, _ = costs.shape
    total = np.zeros(costs.shape, int)
    for dy, dx in ways:
        L = np.zeros(costs.shape, int)
        for y in range(height) if dy >= 0 else range(height - 1, -1, -1):
            for x in range(width) if dx >= 0 else range(width - 1, -1, -1):
                from_y, from_x = y - dy, x - dx
                L[y, x] = costs[y, x]
                if 0 <= from_y < height and 0 <= from_x < width:
                    step = abs(int(image[y, x]) - int(image[from_y, from_x]))
                    jump = max(_P2 * _EDGE // (_EDGE + step), _P1 + 4)
                    q = L[from_y, from_x]
                    slanted = np.minimum(np.append(q[1:], 10**6), np.insert(q[:-1], 0, 10**6)) + _P1
                    L[y, x] += np.minimum(np.minimum(q, slanted), q.min() + jump) - q.min()
        total += L
    return total


@pytest.mark.parametrize("paths", WAYS)
def test_semiglobal_totals_are_those_of_the_definition(paths):
    left, right, _ = (a[30:54, 60:100] if isinstance(a, np.ndarray) else a for a in layers(noise=3.0))
    left, right = np.ascontiguousarray(left), np.ascontiguousarray(right)
    count = 12
    search = Search(0, count)
    raw = raw_costs(
        left, right, search, range(-2, 3), 13, lambda n, *at: n + min(birchfield_tomasi(left, right, *at), 20) // 2
    )
    total, found = totals(smoothed(raw), left, WAYS[paths]), Semiglobal(paths).search(left, right, search)
    allowed = np.arange(count)[None, :] <= np.arange(left.shape[1])[:, None]
    masked = np.where(allowed, total, 10**6)
    np.testing.assert_array_equal(found.least, masked.min(axis=2))
    whole = masked.argmin(axis=2)
    assert (np.abs(found.disparity - whole) <= 0.5).all()


def test_no_path_cost_leaves_a_byte():
    assert 3 * int(_RAW_MAX) + _P1 + _P2 <= 255


def test_strips_meet_without_a_seam(monkeypatch):
    left, right, _ = layers(height=220)
    whole = Semiglobal(8).match(left, right, Search(0, 32))
    monkeypatch.setattr("armsight.vision.dense.semiglobal._STRIP_ROWS_KEPT", 1000)
    one = Semiglobal(8).match(left, right, Search(0, 32))
    both = whole.measured & one.measured
    # Paths forget: what 24 rows of run-up leave out changes a winner in few pixels, all near the strips' ends.
    assert both.mean() > 0.8
    assert np.mean(np.abs(whole.disparity - one.disparity)[both] > 0.5) < 0.002
