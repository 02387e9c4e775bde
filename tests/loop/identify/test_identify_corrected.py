"""An identified arm in use: beyond the readings seen, and written and read."""

from dataclasses import replace

import numpy as np
import pytest
from worn_arm import poses, worn

import armsight
from armsight.errors import InputError
from armsight.loop.identify.corrected import Corrected, table_text
from armsight.loop.identify.identify import identify
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import FADE_RAD, fade


@pytest.fixture(scope="module")
def arm():
    """An arm whose joints were seen from -24 to 57 degrees about home, tracked at one point."""
    w, rng = worn(1), np.random.default_rng(5)
    q = w.nominal.home + np.deg2rad(rng.uniform(-24, 57, (120, 6)))
    approach = poses(w.nominal, 120, rng)[1]
    seen = w.seen(q, approach, rng)
    found = identify(w.nominal, Measured(q, seen.p_rig, None, None, approach))
    curve = found.model.names.index("wave2_cos2"), found.model.names.index("ripple2_sin3")
    x = found.solution.x.copy()  # a curve in joint 2, whatever was selected
    x[list(curve)] = 4e-3, -2e-3
    return replace(Corrected.of(found), x=x)


def test_one_reading_has_one_pose(arm):
    q, sides = arm.model.arm.home + np.full((2, 6), [[0.1], [-0.2]]), np.ones((2, 6))
    np.testing.assert_array_equal(arm.forward(q[1], sides[1]), arm.forward(q, sides)[1])
    np.testing.assert_array_equal(arm.forward(q[0].tolist()), arm.forward(q)[0])


def curves(arm):
    """The arm with the curves of its sensors alone."""
    model, x = arm.model, arm.x.copy()
    for k, feature in enumerate(model.features):
        if feature.kind not in ("gain", "wave", "ripple"):
            x[model.sources_at + k] = 0.0
    return replace(arm, x=x)


def test_within_the_readings_seen_a_curve_is_what_was_fitted(arm):
    low, high = arm.model.q_seen.T
    q = low + (high - low) * np.linspace(0, 1, 9)[:, None]
    unfaded = replace(arm, model=replace(arm.model, q_seen=None))
    np.testing.assert_allclose(arm.joint_corrections(q), unfaded.joint_corrections(q), rtol=0, atol=1e-15)


def test_far_beyond_them_only_the_curves_mean_is_left(arm):
    """The mean against the average of the curve itself over the range, by the midpoint rule on 20000 intervals."""
    only, (low, high) = curves(arm), arm.model.q_seen.T
    middles = low + (high - low) * ((np.arange(20000) + 0.5) / 20000)[:, None]
    mean = only.joint_corrections(middles).mean(axis=0)
    assert np.abs(mean).max() > 1e-4
    for q in (low - FADE_RAD - 1e-9, high + FADE_RAD + 1e-9, high + np.deg2rad(60)):
        np.testing.assert_allclose(only.joint_corrections(q[None])[0], mean, rtol=0, atol=1e-9)


def test_a_curve_fades_without_a_jump_of_its_slope(arm):
    only, high, h = curves(arm), arm.model.q_seen[:, 1], 1e-6
    for end in (high, high + FADE_RAD):
        at = np.stack([end - h, end, end + h])
        before, after = np.diff(only.joint_corrections(at), axis=0) / h
        # curvature of the fade, 6 / FADE_RAD^2, times a curve of 0.01 rad, over h
        np.testing.assert_allclose(before, after, rtol=0, atol=h * 20 * 6 / FADE_RAD**2 * 0.01 + 1e-9)
    t = np.linspace(1.0, 1.0 + FADE_RAD, 200)
    falling = fade(t, 0.0, 1.0)
    assert falling[0] == 1.0
    assert falling[-1] == pytest.approx(0.0, abs=1e-12)
    assert (np.diff(falling) <= 0).all()


def test_what_is_written_is_read_with_the_same_corrections(arm, tmp_path):
    path, rng = tmp_path / "corrected.toml", np.random.default_rng(0)
    arm.save(path)
    back = armsight.open_corrected(path)
    assert back.notes == ()
    assert back.moved_m == arm.moved_m
    newer = tmp_path / "newer.toml"
    newer.write_text(path.read_text().replace("version = 3", "version = 4"))
    with pytest.raises(InputError, match="corrected arm version 4, this armsight reads up to 3: update armsight"):
        armsight.open_corrected(newer)
    q, approach = rng.uniform(-3, 3, (50, 6)), rng.choice([-1.0, 0.0, 1.0], (50, 6))
    for sides in (None, approach):
        np.testing.assert_allclose(
            back.joint_corrections(q, sides), arm.joint_corrections(q, sides), rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(back.forward(q, sides), arm.forward(q, sides), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(back.model.q_seen, arm.model.q_seen)
    np.testing.assert_allclose(back.model.T_rig_base(back.x), arm.model.T_rig_base(arm.x), rtol=0, atol=1e-12)
    assert armsight.open_arm(path).name == arm.model.arm.name


def test_a_file_of_version_2_is_read_unfaded_with_a_note(arm, tmp_path):
    lines = table_text(arm).replace("version = 3", "version = 2").splitlines()
    old = tmp_path / "old.toml"
    dropped = ("seen_", "nominal_", "curve_fade_rad", "up_base")
    old.write_text("\n".join(line for line in lines if not line.startswith(dropped)))
    back = armsight.open_corrected(old)
    assert back.model.q_seen is None
    assert "do not fade" in " ".join(back.notes)
    assert "levers of gravity" in " ".join(back.notes)
    q = arm.model.q_seen[:, 1] + 1.0
    unfaded = curves(replace(arm, model=replace(arm.model, q_seen=None)))
    np.testing.assert_allclose(
        curves(back).joint_corrections(q[None]), unfaded.joint_corrections(q[None]), rtol=0, atol=1e-12
    )


def test_a_file_of_version_1_is_read(arm, tmp_path):
    """It said no version, had other names of the kinds of gravity, and [[cause]] tables; here of an arm of any name."""
    x, name = arm.x.copy(), '\U0001f9be "worn\\ \x7f'
    x[[arm.model.names.index(name) for name in ("gravity_backlash3", "compliance2_3")]] = 2e-3, 1e-3
    arm = replace(arm, x=x, model=replace(arm.model, arm=replace(arm.model.arm, name=name)))
    text = table_text(arm).replace("version = 3\n", "").replace("[[error_source]]", "[[cause]]")
    old = tmp_path / "old.toml"
    old.write_text(
        text.replace('"gravity_backlash3"', '"slack3"').replace('"compliance2_3"', '"sag2_3"'), encoding="utf-8"
    )
    arm.save(tmp_path / "new.toml")
    new, first = (armsight.open_arm(tmp_path / file) for file in ("new.toml", "old.toml"))
    assert new.name == first.name == name
    np.testing.assert_array_equal(new.table, first.table)
    q = np.random.default_rng(2).uniform(-1, 1, (20, 6))
    back = armsight.open_corrected(old)
    np.testing.assert_allclose(back.joint_corrections(q), arm.joint_corrections(q), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("identified = true\n", ""), "no identified arm"),
        (('name = "wave2_cos2"', 'name = "wave7_cos2"'), "error source 'wave7_cos2' is unknown"),
        (("curve_fade_rad = ", "curve_fade_rad = -"), "curve_fade_rad"),
        (("seen_max_rad = ", "seen_most_rad = "), "seen_max_rad"),
        (("\ntool_moved_m = ", '\ntool_moved_m = "x"  # '), "tool_moved_m is 'x', must be a number"),
    ],
)
def test_a_wrong_file_is_rejected_by_name(arm, tmp_path, change, said):
    path = tmp_path / "corrected.toml"
    path.write_text(table_text(arm).replace(*change))
    with pytest.raises(InputError, match=said) as caught:
        armsight.open_corrected(path)
    assert str(path) in str(caught.value)
