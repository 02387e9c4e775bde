"""What is wrong with an arm: presets, files, and how it is sampled."""

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.robot.arm_file import open_arm
from armsight.sim.workcell.arm import PRESETS, imperfections, sample_arm
from armsight.sim.workcell.motors import chosen, solids
from armsight.sim.workcell.workcell import configuration

MODEL = open_arm("six_r")


def test_a_nominal_arm_is_its_table():
    true = sample_arm(MODEL, PRESETS["nominal"], 3)
    assert (true.arm.table == MODEL.table).all()
    assert not true.backlash_rad.any()
    assert not true.pot_offset_rad.any()
    assert not true.pot_sines[:, :, 0].any()


@pytest.mark.parametrize("seed", range(5))
def test_a_worn_arm_is_off_by_what_the_preset_says(seed):
    given = PRESETS["worn"]
    true = sample_arm(MODEL, given, seed)
    for name, amount, rows in (
        ("a", given.length_m, slice(0, 5)),
        ("d", given.length_m, slice(1, 5)),
        ("alpha", given.angle_rad, slice(0, 5)),
        ("offset", given.zero_rad, slice(1, 5)),
    ):
        off = np.abs(getattr(true.arm, name) - getattr(MODEL, name))
        assert (off[rows] >= 0.5 * amount - 1e-15).all(), name
        assert (off[rows] <= 1.5 * amount + 1e-15).all(), name
        others = np.delete(off, np.arange(6)[rows])
        assert not others.any(), name
    assert (true.backlash_rad >= given.backlash_rad[0]).all()
    assert (true.backlash_rad <= given.backlash_rad[1]).all()


def test_what_only_moves_base_and_tool_is_not_wrong():
    """Errors in these entries of the table leave every motion as it was, seen from a rig that was calibrated by motions."""
    true = sample_arm(MODEL, PRESETS["worn"], 0).arm
    assert (true.d[[0, 5]] == MODEL.d[[0, 5]]).all()
    assert (true.offset[[0, 5]] == MODEL.offset[[0, 5]]).all()
    assert (true.a[5], true.alpha[5]) == (MODEL.a[5], MODEL.alpha[5])


def test_the_same_seed_gives_the_same_arm_and_another_another():
    first, again, other = (sample_arm(MODEL, PRESETS["worn"], seed) for seed in (1, 1, 2))
    assert (first.arm.table == again.arm.table).all()
    assert (first.pot_sines == again.pot_sines).all()
    assert (first.arm.table != other.arm.table).any()


def test_a_file_changes_what_it_names(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('preset = "worn"\nlength_mm = 2.0\nbacklash_deg = [0.0, 0.1]\nadc_bits = 10\n')
    given = imperfections(str(path))
    assert given.length_m == pytest.approx(0.002)
    assert given.backlash_rad == pytest.approx((0.0, np.deg2rad(0.1)))
    assert given.adc_bits == 10
    assert given.zero_rad == PRESETS["worn"].zero_rad


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("lenght_mm = 1.0", "unknown key 'lenght_mm'"),
        ("length_mm = -1.0", "length_mm must be 0 to 20"),
        ("length_mm = nan", "length_mm must be"),
        ("length_mm = true", "length_mm must be"),
        ('length_mm = "1"', "length_mm must be"),
        ("backlash_deg = 0.1", r"\[least, greatest\]"),
        ("backlash_deg = [0.2, 0.1]", r"\[least, greatest\]"),
        ("adc_bits = 12.5", "a whole number"),
        ('preset = "old"', "preset is 'old'; known are nominal, used, worn"),
        ("preset = [", "not TOML"),
    ],
)
def test_a_bad_file_is_reported_by_name(tmp_path, text, said):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as error:
        imperfections(str(path))
    assert "mine.toml" in str(error.value)


def test_an_unknown_arm_lists_the_known(tmp_path):
    with pytest.raises(InputError, match="known are nominal, used, worn, or a TOML file"):
        imperfections("broken")
    with pytest.raises(InputError, match="no such file"):
        imperfections(str(tmp_path / "none.toml"))


@pytest.mark.parametrize("name", ["six_r", "puma560", "ur5", "ur10", "irb120"])
def test_every_arm_gets_a_configuration_that_the_board_takes(name):
    model = open_arm(name)
    parts = solids(model)
    motors = chosen(model, parts)
    config = configuration(model, parts, motors)  # rejects by itself what a board would reject
    assert (motors.no_load_rad_s > 1.5 * model.qd_max).all()
    assert (motors.stall_nm > 3 * motors.gravity_nm).all()
    assert (config["joint"]["gains"]["kp_per_rad"] > 0).all()
