"""The host's check of a configuration says the same as the firmware's own, and names what is wrong."""

import ctypes

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from armsight import firmware
from armsight.errors import InputError
from armsight.robot.boards.configuration import (
    CONFIG,
    ENCODER,
    check_configuration,
    check_gains,
    gains_array,
    lab_configuration,
)


@pytest.fixture(scope="module")
def is_valid():
    """The firmware's own word on a configuration."""
    function = ctypes.CDLL(str(firmware.host_library())).config_is_valid
    function.restype, function.argtypes = ctypes.c_bool, [ctypes.c_char_p]
    return lambda config: function(config.tobytes())


def paths(dtype, path=()):
    """Every field of a record, by its path."""
    for name in dtype.names:
        base = dtype[name].subdtype[0] if dtype[name].subdtype else dtype[name]
        if base.names:
            yield from paths(base, (*path, name))
        else:
            yield (*path, name)


FIELDS = list(paths(CONFIG))
EDGES = [
    0, 1, 2, 3, 100, 101, 1000, 1001, 10000, 10001, 60000, 60001, -1, 1e-4, 1e-3, 0.01, 0.1, 13, -13, 13.01, 20,
    20.1,
]  # fmt: skip


def changed(path, joint, item, value):
    config = lab_configuration()
    field = config
    for name in path[:-1]:
        field = field[name]
    field = field[path[-1]]
    index = (joint,) if path[0] == "joint" else ()
    if field.ndim > len(index):
        index += (item,)
    with np.errstate(all="ignore"):
        field[index] = np.array(value).astype(field.dtype)
    return config


def is_good(config):
    try:
        check_configuration(config)
    except InputError:
        return False
    return True


def test_the_labs_configuration_is_good(is_valid):
    assert is_valid(lab_configuration())
    check_configuration(lab_configuration())


values = st.one_of(st.sampled_from(EDGES), st.floats(-2e4, 7e4), st.just(float("nan")), st.just(float("inf")))


@given(path=st.sampled_from(FIELDS), joint=st.integers(0, 5), item=st.integers(0, 8), value=values)
@example(path=("silence_ticks",), joint=0, item=0, value=1)
@example(path=("joint", "pot", "jump_rad"), joint=2, item=0, value=1e-4)
def test_the_host_rejects_what_the_board_would(is_valid, path, joint, item, value):
    config = changed(path, joint, item, value)
    assert is_good(config) == is_valid(config), path


def test_every_range_is_held_on_both_sides(is_valid):
    for path in FIELDS:
        for value in EDGES:
            config = changed(path, 1, 1, value)
            assert is_good(config) == is_valid(config), (path, value)


@pytest.mark.parametrize("sensor", [1, 2])
def test_an_encoders_ranges_are_held_on_both_sides(is_valid, sensor):
    edges = [*EDGES, 6, 7, 15.9, 16, 628, 629, 1e7, 2e7, 16383, 16384]
    fields = [("joint", "encoder", name) for name in ENCODER.names]
    for path in [*fields, ("joint", "soft_max_rad"), ("joint", "pot", "jump_rad"), ("joint", "pot", "counts")]:
        for value in edges:
            config = changed(path, 1, 0, value)
            encoders, given = config["joint"]["encoder"], config["joint"]["encoder"][1].copy()
            encoders[1] = (sensor, 2, 16384.0, 1, 0, 0.0)
            if path[1] == "encoder":
                encoders[path[2]][1] = given[path[2]]
            encoders[0] = (1, 3, 16384.0, 1, 0, 0.0)
            assert is_good(config) == is_valid(config), (path, value)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("joint", "soft_min_rad"), 2.5, "joint 2: soft_min_rad must be below soft_max_rad"),
        (("joint", "pot", "direction"), 0, "joint 2: direction is 0; 1 or -1 is allowed"),
        (("joint", "pot", "counts"), 1, "joint 2: the counts of the potentiometer's table must rise"),
        (("joint", "pot", "angle_rad"), -2.6, "joint 2: the angles of the potentiometer's table"),
        (("joint", "pot", "short_counts"), 65000, "joint 2: short_counts must be below open_counts"),
        (("joint", "gains", "ki_per_rad_s"), 1001, "joint 2: ki_per_rad_s is 1001; 0 to 1000 is allowed"),
        (("joint", "soft_max_rad"), 2.7, "joint 2: the soft limits must lie within the potentiometer's table"),
        (("joint", "stall_duty"), 0.9, "joint 2: stall_duty must not be beyond duty_limit"),
        (("joint", "speed_limit_rad_s"), 20.0, "joint 2: jump_rad must be further than the joint moves in a tick"),
        (("silence_reaction",), 3, "silence_reaction is 3; 1 .hold. or 2 .release. is allowed"),
        (("supply_min_mv",), 15000, "supply_min_mv must be below supply_max_mv"),
        (("pot_ticks",), 0, "pot_ticks is 0; 1 to 100 is allowed"),
    ],
)
def test_what_is_wrong_is_named(path, value, said):
    with pytest.raises(InputError, match=said):
        check_configuration(changed(path, 1, 1, value))


def test_something_else_is_no_configuration():
    with pytest.raises(InputError, match="this is no configuration"):
        check_configuration(np.zeros(3))
    with pytest.raises(InputError, match="this is no configuration"):
        check_configuration(np.zeros(2, CONFIG))


def test_gains_keep_their_order():
    config = lab_configuration()
    config["joint"]["gains"][4] = (1, 2, 3, 4, 5, 0.25, 0.5, 6)
    assert gains_array(config)[4].tolist() == [1, 2, 3, 4, 5, 0.25, 0.5, 6]
    assert check_gains(gains_array(config)).shape == (6, 8)
