"""How far backlash reaches beyond where a joint was found."""

import numpy as np
import pytest

from armsight.loop.identify.backlash import JointBacklash, _widened


@pytest.mark.parametrize("sides", [(30, 30), (50, 10), (59, 1)])
def test_each_stop_is_where_the_furthest_of_its_own_poses_is(sides):
    """Against samples: the furthest of those that came from below, and of those from above."""
    rng, chance, samples = np.random.default_rng(1), 2e-4, 4000
    furthest = np.array([rng.normal(0, chance, (samples, n)).max(axis=1) for n in sides])
    found = _widened(JointBacklash(0, 3e-3, 1e-5, "it came from"), chance, 0.0, sides)
    # Blom's rule is good to 0.01 sigma at each stop; and four sigmas of the samples' mean.
    allowed = 0.02 * chance + 4 * furthest.sum(axis=0).std() / np.sqrt(samples)
    assert found.value_rad - 3e-3 == pytest.approx(furthest.sum(axis=0).mean(), abs=allowed)


def test_backlash_that_does_not_show_stays_so():
    found = _widened(JointBacklash(0, np.nan, np.nan, "why"), 2e-4, 0.0, (0, 0))
    assert np.isnan([found.value_rad, found.sigma_rad]).all()
