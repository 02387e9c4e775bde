"""An arm whose base or body was displaced while its poses were taken: it is named, and the sigmas hold both states."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from worn_arm import poses, worn

from armsight.geometry.pose import exp_se3, inverse
from armsight.loop.identify.identify import identify
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.misread import placed_change
from armsight.loop.identify.selection import change_text
from armsight.loop.identify.validate import with_change_allowed

COUNT, FROM, BY = 60, 30, np.array([0, 2e-3, 0, 0, 0, 0])


def seen(w, seed, displaced):
    """A body of a worn arm; the base, or the body on its flange, is displaced by 2 mm midway."""
    rng = np.random.default_rng(seed)
    q, approach = poses(w.nominal, COUNT, rng)
    measured = w.seen(q, approach, rng)
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = measured.R_rig_body, measured.p_rig[:, 0]
    if displaced == "base":
        T[FROM:] = w.T_rig_base @ exp_se3(BY) @ inverse(w.T_rig_base) @ T[FROM:]
    if displaced == "tool":
        T[FROM:] = T[FROM:] @ exp_se3(BY)
    points = T[:, :3, 3] + T[:, :3, :3] @ [0.03, 0.02, 0.05]
    return replace(measured, p_rig=points[:, None], R_rig_body=None, cov=None, approach=None)


@pytest.mark.parametrize("displaced", ["base", "tool"])
def test_a_displacement_is_named_and_the_sigmas_allow_for_it(displaced):
    w = worn(71, waves=0, backlash=False, compliance=False)
    measured = seen(w, 71, displaced)
    alone = identify(w.nominal, measured)
    found = with_change_allowed(alone, measured)
    assert found.change is not None
    assert found.change.way == displaced
    assert abs(found.change.row - FROM) <= 2
    assert "was displaced by" in change_text(found.model, found.change)
    assert f"from pose {found.change.row} on the poses are of another state" in found.notes[-1]
    assert (np.diag(found.cov) >= np.diag(alone.cov)).all()
    assert np.sqrt(np.diag(found.cov - alone.cov)[found.change.columns]).max() > 0.4e-3


def test_of_several_points_the_largest_shift_is_named():
    w, rng = worn(73), np.random.default_rng(73)
    q, _ = poses(w.nominal, 40, rng)
    T, at = w.nominal.forward(q), np.tile([[0, 0, 0.05], [0.05, 0, 0], [0, 0.05, 0]], (40, 1, 1))
    at[20:, 1:] += 0.01
    p = T[:, None, :3, 3] + at @ T[:, :3, :3].swapaxes(1, 2) + 1e-4 * rng.standard_normal(at.shape)
    model, change = placed_change(w.nominal, Measured(q, p))
    assert (change.way, change.row) == ("tool", 20)
    assert "was displaced by 17.3 mm" in change_text(model, change)
    small = SimpleNamespace(way=change.way, step=1e-3 * change.step)
    assert "was displaced by 0.017 mm" in change_text(model, small)


def test_nothing_is_named_where_nothing_was_displaced():
    w = worn(72)
    measured = seen(w, 72, None)
    found = identify(w.nominal, measured)
    assert with_change_allowed(found, measured) is found
