"""Points near each other, against SciPy's tree."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from armsight.geometry.near import nearest, pairs_within


@pytest.mark.parametrize(("count", "reach"), [(1, 1.0), (2, 0.0), (60, 0.2), (60, 10.0)])
def test_pairs_are_those_of_a_tree(count, reach):
    points = np.random.default_rng(count).normal(size=(count, 3))
    points[count // 2] = points[0]  # the same point twice
    pairs = pairs_within(points, reach)
    assert set(map(tuple, pairs.tolist())) == KDTree(points).query_pairs(reach)
    assert len(pairs_within(points, reach, 5)) == min(len(pairs), 5)


def test_the_nearest_is_that_of_a_tree():
    points, asked = np.random.default_rng(1).normal(size=(2, 40, 2))
    rows, squares = np.empty(40, np.int64), np.empty(40)
    for q, k in ((asked, 1), (points, 2)):
        nearest(points, q, k == 1, rows, squares)
        distances, there = KDTree(points).query(q, k=[k])
        np.testing.assert_array_equal(rows, there[:, 0])
        np.testing.assert_allclose(np.sqrt(squares), distances[:, 0])
