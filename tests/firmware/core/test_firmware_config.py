"""The configuration: two stored copies, and what each value may be."""

import ctypes
import random
import zlib

import pytest
from firmware_arm import LabArm, lab_config
from firmware_layout import RECORDS, c

COPY_BYTES = ctypes.sizeof(c.config_copy)


def config_of(library, silence_ticks):
    """A configuration that can be distinguished from others."""
    config = lab_config(library)
    config.silence_ticks = silence_ticks
    return config


def sealed(library, silence_ticks, serial):
    copy = c.config_copy()
    library.config_seal(ctypes.byref(copy), ctypes.byref(config_of(library, silence_ticks)), serial)
    return copy


def load(library, first, second):
    """(where it came from, its silence_ticks)."""
    config = c.core_config()
    source = library.config_load(ctypes.byref(config), ctypes.byref(first), ctypes.byref(second))
    return source, config.silence_ticks


def following(library, first, second):
    """(which copy to write, with which serial number)."""
    serial = ctypes.c_uint32()
    return library.config_next(ctypes.byref(first), ctypes.byref(second), ctypes.byref(serial)), serial.value


def test_records_are_laid_out_as_the_header_is_read(library):
    for name, record in RECORDS.items():
        assert library.host_size(name.encode()) == ctypes.sizeof(record), name
    assert library.host_size(b"core") == 0


@pytest.mark.parametrize("length", [0, 1, 7, 936])
def test_the_crc_is_the_usual_one(library, length):
    data = random.Random(length).randbytes(length)
    assert library.config_crc(data, length) == zlib.crc32(data)


def test_the_newer_of_two_good_copies_is_used(library):
    old, new = sealed(library, 111, 4), sealed(library, 222, 5)
    assert load(library, old, new) == (c.CONFIG_NEWEST, 222)
    assert load(library, new, old) == (c.CONFIG_NEWEST, 222)


def test_serial_numbers_may_wrap(library):
    old, new = sealed(library, 111, 2**32 - 1), sealed(library, 222, 0)
    assert load(library, old, new) == (c.CONFIG_NEWEST, 222)
    assert load(library, new, old) == (c.CONFIG_NEWEST, 222)


@pytest.mark.parametrize("order", [1, -1], ids=["newer second", "newer first"])
def test_the_older_copy_is_used_whichever_byte_of_the_newer_is_flipped(library, order):
    draw = random.Random(order)
    old = sealed(library, 111, 4)
    whole = bytes(sealed(library, 222, 5))
    for at in range(COPY_BYTES):
        broken = bytearray(whole)
        broken[at] ^= 1 << draw.randrange(8)
        pair = (old, c.config_copy.from_buffer(broken))
        assert load(library, *pair[::order]) == (c.CONFIG_OLDER, 111)


@pytest.mark.parametrize("byte", [b"\x00", b"\xff"], ids=["zeros", "erased"])
def test_without_a_good_copy_the_factory_values_are_used_and_the_arm_stays_off(library, byte):
    empty = c.config_copy.from_buffer_copy(byte * COPY_BYTES)
    factory = c.core_config()
    library.config_factory(ctypes.byref(factory))
    assert load(library, empty, empty) == (c.CONFIG_FACTORY, factory.silence_ticks)
    assert library.config_is_valid(ctypes.byref(factory))
    arm = LabArm(library, factory, source=c.CONFIG_FACTORY)
    arm.enable()
    assert not arm.acknowledged()
    assert arm.outputs.first_fault == c.FAULT_CONFIG


def test_a_sealed_copy_with_a_value_outside_its_range_is_broken(library):
    config, copy = config_of(library, 222), c.config_copy()
    config.joint[2].duty_limit = 1.5
    library.config_seal(ctypes.byref(copy), ctypes.byref(config), 9)
    assert load(library, sealed(library, 111, 4), copy) == (c.CONFIG_OLDER, 111)


def test_a_copy_of_another_version_is_broken(library):
    copy = sealed(library, 222, 9)
    copy.version += 1
    copy.crc = zlib.crc32(bytes(copy)[:-4])
    assert load(library, sealed(library, 111, 4), copy) == (c.CONFIG_OLDER, 111)


def of_version_5(copy):
    """The bytes of a copy as version 5 stored it: a joint ended before its transmission."""
    raw, joint, start = bytes(copy), ctypes.sizeof(c.joint_config), c.config_copy.config.offset
    kept = raw[:4] + (5).to_bytes(4, "little") + raw[8:start]
    for i in range(6):
        kept += raw[start + i * joint :][: c.joint_config.transmission.offset]
    kept += raw[start + 6 * joint : -4]
    return kept + zlib.crc32(kept).to_bytes(4, "little")


def test_a_copy_of_version_5_is_read_with_zeros_for_what_is_new(library):
    config = config_of(library, 222)
    for i, joint in enumerate(config.joint):
        joint.soft_max_rad, joint.encoder.home_rad, joint.motor.backlash_rad = 2.0 + 0.1 * i, 0.1 * i, 0.001 * i
    whole = c.config_copy()
    library.config_seal(ctypes.byref(whole), ctypes.byref(config), 9)
    old = of_version_5(whole)
    copy = c.config_copy.from_buffer_copy(old + b"\xff" * (COPY_BYTES - len(old)))
    library.config_upgrade(ctypes.byref(copy))
    assert bytes(copy) == bytes(whole)
    library.config_upgrade(ctypes.byref(copy))  # one of this version stays as it is
    assert bytes(copy) == bytes(whole)
    for at in range(0, len(old), 7):
        broken = bytearray(old + b"\xff" * (COPY_BYTES - len(old)))
        broken[at] ^= 4
        copy = c.config_copy.from_buffer_copy(broken)
        library.config_upgrade(ctypes.byref(copy))
        assert bytes(copy) == bytes(broken)


def test_a_power_cut_while_writing_never_costs_the_only_good_copy(library):
    """Write a hundred configurations, each write cut off somewhere: what is loaded is the last whole one."""
    draw = random.Random(7)
    store = [bytearray(b"\xff" * COPY_BYTES), bytearray(b"\xff" * COPY_BYTES)]
    copies = [c.config_copy.from_buffer(slot) for slot in store]
    last = None
    for number in range(100, 200):
        slot, serial = following(library, *copies)
        assert serial == (1 if last is None else copies[1 - slot].serial + 1)
        whole = bytes(sealed(library, number, serial))
        cut = draw.choice([0, COPY_BYTES, draw.randrange(COPY_BYTES)])
        store[slot][:] = whole[:cut] + b"\xff" * (COPY_BYTES - cut)
        last = number if cut == COPY_BYTES else last
        source, loaded = load(library, *copies)
        assert last is None or (source != c.CONFIG_FACTORY and loaded == last)


NAN, INF = float("nan"), float("inf")
WRONG = {
    "gains.kp_per_rad": [-0.1, 100.1, NAN, INF],
    "gains.ki_per_rad_s": [-1, 1001, NAN],
    "gains.kd_s_per_rad": [-1, 101, NAN],
    "gains.kv_s_per_rad": [-1, 101, NAN],
    "gains.ka_s2_per_rad": [-0.1, 11, NAN],
    "gains.kf_duty": [-0.1, 1.1, NAN],
    "gains.derivative_filter_s": [-0.001, 1.1, NAN],
    "gains.anti_windup_per_s": [-1, 1001, NAN],
    "pot.node_count": [0, 1, 10],
    "pot.counts.1": [3277, 0],
    "pot.short_counts": [64500, 65000, 3277],
    "pot.open_counts": [62258, 900],
    "pot.angle_rad.0": [2.6, 14, NAN],
    "pot.angle_rad.1": [-13.5, NAN, INF],
    "pot.direction": [0, 2, -2],
    "pot.jump_rad": [0, 1.1, NAN],
    "pot.frozen_rad": [0, 1.1, NAN],
    "pot.inverted_rad": [0, 1.1, NAN],
    "motor.resistance_ohm": [-1, 1001, NAN],
    "motor.constant_v_s": [0, 1001, NAN],
    "motor.apart_rad": [0, 1.1, 0.01, NAN],
    "motor.backlash_rad": [-0.001, 0.03, 1.1, NAN],
    "transmission.twist_rad_per_a": [-0.001, 1.1, NAN],
    "transmission.uneven": [-0.001, 0.51, NAN],
    "transmission.damping_share": [-0.001, 1.1, NAN],
    "soft_min_rad": [2.4, -13.1, -2.7, NAN],
    "soft_max_rad": [-2.4, 13.1, 2.7, NAN],
    "speed_limit_rad_s": [0, 20.0, 20.1, NAN],
    "deceleration_rad_s2": [0, 1001, NAN],
    "acceleration_rad_s2": [0, 1001, NAN],
    "jerk_rad_s3": [0, 2e6, NAN],
    "gravity_slew_per_s": [0, 1001, NAN],
    "duty_limit": [-0.1, 0.4, 1.01, NAN],
    "duty_slew_per_s": [0, 1001, NAN],
    "current_cut_per_a_s": [-1, 1001, NAN],
    "following_rad": [0, 14, NAN],
    "stall_duty": [0, 0.81, 1.01, NAN],
    "stall_rad": [0, 1.01, NAN],
    "current_limit_ma": [0, 9, 500001],
    "motor_direction": [0, 3],
    "encoder.sensor": [3],
}
WRONG_ARM = {
    "joint_count": [0, 7],
    "supply_min_mv": [14000, 10],
    "supply_nominal_mv": [999, 100001],
    "overload_ticks": [0, 10001],
    "brake_release_ticks": [1001],
    "brake_engage_ticks": [1001],
    "supply_ticks": [0, 1001],
    "pot_ticks": [0, 101],
    "following_ticks": [0, 10001],
    "stall_ticks": [0, 10001],
    "silence_ticks": [1, 60001],
    "silence_reaction": [0, 3],
    "sync_led_pin": [1, 15, 144],
    "sync_led_ticks": [0, 101],
}


def put(record, path, value):
    *folders, last = path.split(".")
    for name in folders:
        record = getattr(record, name)
    if last.isdigit():
        record[int(last)] = value
    else:
        setattr(record, last, value)


def test_a_value_outside_its_range_makes_the_configuration_invalid(library):
    for path, value in ((path, value) for path, values in {**WRONG, **WRONG_ARM}.items() for value in values):
        config = lab_config(library)
        assert library.config_is_valid(ctypes.byref(config))
        put(config.joint[4] if path in WRONG else config, path, value)
        assert not library.config_is_valid(ctypes.byref(config)), (path, value)
        arm = LabArm(library, config)  # even where it is handed over as good
        assert arm.tick().first_fault == c.FAULT_CONFIG
        assert arm.core.config.silence_ticks == 100


# Of an encoder: the kinds whose range it is, and what each may not be. Its limits are 3.14 rad to either side of its home.
BOTH = (c.SENSOR_QUADRATURE, c.SENSOR_ABSOLUTE)
WRONG_ENCODER = {
    "encoder.input": ((c.SENSOR_QUADRATURE,), [0, 7, 4]),  # 4: the other one's
    "encoder.zero_counts": ((c.SENSOR_ABSOLUTE,), [16384]),
    "encoder.counts_per_rev": (BOTH, [15, 64, 2e7, NAN]),  # 64: a step is larger than a jump
    "encoder.direction": (BOTH, [0, 2]),
    "encoder.home_rad": (BOTH, [-13.5, 13.5, NAN]),
    "pot.frozen_rad": ((c.SENSOR_QUADRATURE,), [0.001]),
    "soft_min_rad": ((c.SENSOR_ABSOLUTE,), [-2.9]),
    "soft_max_rad": ((c.SENSOR_ABSOLUTE,), [3.9]),
}


@pytest.mark.parametrize("path", WRONG_ENCODER)
def test_a_value_of_an_encoder_outside_its_range_makes_the_configuration_invalid(library, path):
    kinds, values = WRONG_ENCODER[path]
    for kind in kinds:
        counts_per_rev = 16384 if kind == c.SENSOR_ABSOLUTE else 4096
        for value in values:
            config = lab_config(library)
            config.joint[3].encoder = c.encoder_config(c.SENSOR_QUADRATURE, 4, 16384, 1, 0, 0.0)
            config.joint[4].encoder = c.encoder_config(kind, 5, counts_per_rev, -1, 16383, 0.5)
            assert library.config_is_valid(ctypes.byref(config))
            put(config.joint[4], path, value)
            assert not library.config_is_valid(ctypes.byref(config)), (kind, value)


@pytest.mark.parametrize(("path", "value"), [("sync_led_pin", 16), ("sync_led_pin", 143), ("sync_led_ticks", 100)])
def test_the_ends_of_a_range_belong_to_it(library, path, value):
    config = lab_config(library)
    put(config, path, value)
    assert library.config_is_valid(ctypes.byref(config))


@pytest.mark.parametrize(("angles", "direction"), [((-2.6, 2.6), -1), ((2.6, -2.6), 1), ((2.6, -2.6), -1)])
def test_a_table_may_fall_and_its_direction_be_reversed(library, angles, direction):
    config = lab_config(library)
    pot = config.joint[4].pot
    pot.angle_rad[: pot.node_count], pot.direction = angles, direction
    assert library.config_is_valid(ctypes.byref(config))


def test_every_value_has_its_range_tried(library):
    """A field added to the configuration must be added here."""
    parts = ("gains", "pot", "motor", "encoder", "transmission")
    leaves = {name for name, _ in c.joint_config._fields_ if name not in parts}
    leaves |= {f"gains.{name}" for name, _ in c.joint_gains._fields_}
    leaves |= {f"motor.{name}" for name, _ in c.motor_config._fields_}
    leaves |= {f"transmission.{name}" for name, _ in c.transmission_config._fields_}
    assert leaves <= set(WRONG)
    assert {f"encoder.{name}" for name, _ in c.encoder_config._fields_} <= {*WRONG, *WRONG_ENCODER}
    assert {name for name, _ in c.core_config._fields_} - {"joint", "supply_max_mv"} == set(WRONG_ARM)
