"""board.toml: what is written is read back to the bit, and what is wrong is named."""

import re
from pathlib import Path

import pytest
from board_rigs import written

from armsight.errors import InputError
from armsight.robot.boards.board_file import configuration_text, put, read_configuration
from armsight.robot.boards.configuration import USED_PINS, lab_configuration


def test_what_is_written_is_read_back_to_the_bit(tmp_path):
    config = lab_configuration()
    config["joint"]["gains"]["kp_per_rad"] = [1 / 3, 2 / 7, 0.1, 1e-7, 3.3333333, 99.99999]
    pot = config["joint"]["pot"][2]
    pot["node_count"], pot["counts"][:3], pot["angle_rad"][:3] = 3, (3000, 30000, 62000), (-2.61, 0.123, 2.7)
    path = tmp_path / "board.toml"
    path.write_text(configuration_text(config, "pil"), encoding="utf-8")
    back, board = read_configuration(path)
    assert (back.tobytes(), board) == (config.tobytes(), "pil")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("supply_min_mv = 10000", "supply_min_v = 10"), "nothing is called arm.supply_min_v; is it arm.supply_min_mv"),
        (
            ("supply_min_mv = 10000", "supply_min_mv = 10"),
            "supply_min_mv is 10; half of supply_nominal_mv or more is needed",
        ),
        (
            ("current_limit_ma = 1600", "current_limit_ma = 2"),
            "joint 1: current_limit_ma is 2; 10 to 500000 is allowed",
        ),
        (("current_limit_ma = 1600", "current_limit_ma = -5"), "current_limit_ma is -5; 10 to 500000 is allowed"),
        (("supply_min_mv = 10000", "supply_min_mv = -5"), "supply_min_mv is -5; 0 to 4294967295 is allowed"),
        (("[joint.2]", "[joint.1]"), "not TOML: .*joint"),
        (("joint_count = 6", "joint_count = 5"), "there is joint.6.soft_min_rad, but arm.joint_count is 5: leave"),
        (("soft_max_rad = 2.4", "soft_max_rad = 24.0"), "joint 1: soft_max_rad is 24; -13 to 13 is allowed"),
        (("soft_max_rad = 2.4", "soft_max_rad = '2.4'"), "joint.1.soft_max_rad is '2.4'; a number is needed"),
        (("silence_ticks = 100", "silence_ticks = 100.5"), "arm.silence_ticks is 100.5; a whole number is needed"),
        (("silence_ticks = 100", ""), "arm.silence_ticks is missing"),
        (("version = 6", "version = 1"), "version is 1"),
        (("counts = [3277, 62258]", "counts = [3277]"), r"counts is \[3277\]; a list of 2 to 9 numbers is needed"),
        (("motor_direction = 1", "motor_direction = 0"), "joint 1: motor_direction is 0"),
        (("backlash_rad = 0.01", "backlash_rad = 0.02"), "joint 1: backlash_rad must be below apart_rad"),
        (('led_pin = "none"', "led_pin = 3"), "sync_led_pin is 3; none or a pin such as PB13 is allowed"),
        (('led_pin = "none"', 'led_pin = "PB16"'), "sync_led_pin is 'PB16'; none or a pin"),
    ],
)
def test_what_is_wrong_is_named_with_the_file(tmp_path, change, said):
    path = written(tmp_path, lab_configuration(), change)
    with pytest.raises(InputError, match=rf"board\.toml.*{said}"):
        read_configuration(path)


def test_a_file_of_version_5_is_read_with_zeros_for_what_is_new(tmp_path):
    config = lab_configuration()
    lines = [
        line
        for line in configuration_text(config, "pil").replace("version = 6", "version = 5").splitlines()
        if line.split(" ")[0] not in ("twist_rad_per_a", "uneven", "damping_share") and ".transmission]" not in line
    ]
    path = tmp_path / "board.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    for name in ("twist_rad_per_a", "uneven", "damping_share"):
        config["joint"]["transmission"][name] = 0.0
    assert read_configuration(path)[0].tobytes() == config.tobytes()
    path.write_text("\n".join([*lines, "uneven = 0.1"]), encoding="utf-8")
    with pytest.raises(InputError, match="uneven"):
        read_configuration(path)


@pytest.mark.parametrize(
    "path", ["joint.7.soft_max_rad", "joint.1.pot", "arm.joint", "soft_max_rad", "joint.1.pot.node_count"]
)
def test_a_value_is_put_only_where_there_is_one(path):
    with pytest.raises(InputError, match="nothing is called"):
        put(lab_configuration(), path, 1)


def test_a_file_of_an_arm_with_fewer_joints_has_only_these(tmp_path):
    config = lab_configuration()
    config["joint_count"] = 4
    config["joint"][4:] = 0
    text = configuration_text(config, "pil")
    assert ("[joint.4]" in text, "[joint.5]" in text) == (True, False)
    path = tmp_path / "board.toml"
    path.write_text(text, encoding="utf-8")
    assert read_configuration(path)[0].tobytes() == config.tobytes()
    path.write_text(text.replace("joint_count = 4", "joint_count = 5"), encoding="utf-8")
    with pytest.raises(InputError, match=r"joint\.5\.soft_min_rad is missing"):
        read_configuration(path)


def test_the_sync_led_takes_no_pin_that_has_another_use(tmp_path):
    """The pins in use are those of the documentation's table, which a test holds to the firmware's, and the debugger's."""
    table = Path(__file__).resolve().parents[3] / "docs" / "reference" / "nucleo_pins.md"
    documented = re.findall(r"^\| [^|]+ \| (P[ABC]\d+) \|", table.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert USED_PINS["nucleo-f446re"] == {*documented, "PA13", "PA14"}
    nucleo = ('board = "pil"', 'board = "nucleo-f446re"')
    with pytest.raises(
        InputError, match="sync_led_pin is PA8, which has another use on nucleo-f446re: take a free one"
    ):
        read_configuration(written(tmp_path, lab_configuration(), nucleo, ('led_pin = "none"', 'led_pin = "PA8"')))
    config, _ = read_configuration(
        written(tmp_path, lab_configuration(), nucleo, ('led_pin = "none"', 'led_pin = "PB13"'))
    )
    assert config["sync_led_pin"] == 2 * 16 + 13
