"""The Nucleo's encoders: timers that count, and AS5047 on one SPI, from the pins to the joint's angle in the core."""

import math

import pytest
from firmware_arm import lab_config
from firmware_layout import c
from stm32f4_build import COMPILERS, fresh
from stm32f4_chip import AbsoluteSensor
from stm32f4_emulator import RAM
from test_stm32f4_run import COPIES, sealed

SELECT = "PC{}"
AT = RAM + 4096
PER_REV = 4000.0


def configured(library, sensors: dict[int, tuple[int, int]]):
    """Return a configuration with these sensors, (kind, input) by joint; zeros are 0."""
    config = lab_config(library)
    for joint, (kind, which) in sensors.items():
        config.joint[joint].encoder = c.encoder_config(kind, which, PER_REV if which else c.ENCODER_REV, 1, 0, 0.0)
    return config


def started(compiler: str, config, sensors: dict[int, AbsoluteSensor] | None = None):
    emulator = fresh(compiler)
    emulator.chip.inputs |= {"PA6": 0, "PB12": 0}
    emulator.chip.sensors = {SELECT.format(joint): sensor for joint, sensor in (sensors or {}).items()}
    for copy, at in enumerate(COPIES):
        emulator.uc.mem_write(at, sealed(config, copy + 1))
    emulator.boot()
    return emulator


def read(emulator) -> list[int]:
    """Return what a tick's readings are."""
    emulator.chip.scans(20)
    emulator.call("adc_read", AT)
    emulator.call("encoders_read", AT)
    return list(c.core_inputs.from_buffer_copy(emulator.uc.mem_read(AT, len(bytes(c.core_inputs())))).counts)


def sound(angle: int, diagnosis: int = 0x0180) -> int:
    """Return what two sound frames read as."""
    parity = [(value.bit_count() & 1) << 15 for value in (angle, diagnosis)]
    return angle | parity[0] | (diagnosis | parity[1]) << 16


@pytest.mark.parametrize("compiler", COMPILERS)
def test_counts_of_any_timer_reach_any_joint_and_wrap_where_32_bits_do(compiler, library):
    emulator = started(compiler, configured(library, {4: (1, 1), 0: (1, 2), 2: (1, 3)}))
    chip = emulator.chip
    moved = {"TIM2": 0, "TIM3": 0, "TIM4": 0}
    for step in (100, -300, 30000, 32767, -32768, 32767):
        for k, timer in enumerate(moved):
            chip.count(timer, step // (k + 1))
            moved[timer] += step // (k + 1)
        counts = read(emulator)
        assert [counts[4], counts[0], counts[2]] == [total % 2**32 for total in moved.values()]
    assert [counts[joint] for joint in (1, 3, 5)] == [0, 0, 0]  # potentiometers' pins at ground
    assert chip["TIM2.CCMR1"] == 0x8181  # both inputs filtered
    assert chip.wrongs == []


@pytest.mark.parametrize("compiler", COMPILERS)
def test_each_tick_reads_a_fresh_angle_and_the_diagnosis_of_every_absolute_encoder(compiler, library):
    sensors = {joint: AbsoluteSensor(1000 * joint + 7) for joint in range(6)}
    emulator = started(compiler, configured(library, dict.fromkeys(range(6), (2, 0))), sensors)
    for angle in (0, 1, 8191, 16383):
        for joint, sensor in sensors.items():
            sensor.values[sensor.ANGLE] = (angle + joint) % 16384
        assert read(emulator) == [sound((angle + joint) % 16384) for joint in range(6)]
    sensors[3].values[AbsoluteSensor.DIAGNOSIS] = 0x0580  # the magnet is too weak
    read(emulator)
    assert read(emulator)[3] == sound(16383 + 3 & 16383, 0x0580)
    assert emulator.chip.wrongs == []


@pytest.mark.parametrize("compiler", COMPILERS)
def test_a_frame_that_was_spoiled_on_its_way_is_unsound_and_its_error_is_cleared(compiler, library):
    """The error bit stays in every frame until ERRFL is read: three ticks later the readings are sound again."""
    sensors = {1: AbsoluteSensor(4321), 5: AbsoluteSensor(99)}
    emulator = started(compiler, configured(library, {1: (2, 0), 5: (2, 0)}), sensors)
    for bit in range(16):
        sensors[1].spoiled = 1 << bit
        read(emulator)  # the angle that is answered was asked for before, or is named by the error bit
        seen = [read(emulator)[1] for _ in range(3)]
        assert all(value == sound(4321) or not library.encoder_frames_sound(value) & 1 for value in seen), bit
        assert seen[-1] == sound(4321), bit
        assert read(emulator)[5] == sound(99)
    assert emulator.chip.wrongs == []


def test_an_encoder_that_is_not_there_reads_unsound_and_one_that_wakes_late_is_waited_for(library):
    late = AbsoluteSensor(5)
    late.asleep = 21  # frames: the eleventh ms
    emulator = started(COMPILERS[0], configured(library, {0: (2, 0), 3: (2, 0)}), {0: late})
    counts = read(emulator)
    assert counts[0] == sound(5)
    assert counts[3] == 0
    assert not library.encoder_frames_sound(0) & 1
    assert emulator.chip.wrongs == []


def test_a_dead_spi_holds_a_tick_up_no_longer_than_its_patience(library):
    emulator = started(COMPILERS[0], configured(library, {0: (2, 0)}), {0: AbsoluteSensor(5)})
    emulator.chip.set_spi_dr = lambda name, value: None
    assert read(emulator)[0] == 0


def test_pins_of_encoders_that_are_not_configured_stay_what_they_were(library):
    chip = started(COMPILERS[0], configured(library, {2: (1, 2), 4: (2, 0)}), {4: AbsoluteSensor(0)}).chip
    assert [chip.function(pin) for pin in ("PB4", "PB5", "PC4")] == ["TIM3_CH1", "TIM3_CH2", "output"]
    assert [chip.function(pin) for pin in ("PB6", "PB7", "PC2")] == ["input", "input", "analog"]
    assert chip.output("PC4") == 1.0
    high = chip.first("GPIOC.BSRR", 1 << 4)
    out = next(i for i, (name, value) in enumerate(chip.writes) if name == "GPIOC.MODER" and value >> 8 & 3 == 1)
    assert high < out  # never selected by the way


def test_a_configuration_of_more_than_the_board_has_counts_as_none(library):
    emulator = started(COMPILERS[0], configured(library, {0: (1, 4)}))
    assert emulator.chip.function("PA15") == "nothing"
    assert emulator.chip["RCC.APB1ENR"] & 7 == 0


@pytest.mark.parametrize("compiler", COMPILERS)
def test_an_encoders_motion_is_the_joints_angle_in_telemetry(compiler, library):
    """Pins, timers, SPI, core and wire."""
    from armsight.firmware import dialect

    sensor = AbsoluteSensor(0)
    emulator = started(compiler, configured(library, {0: (1, 1), 1: (2, 0)}), {1: sensor})
    host = dialect().MAVLink(None)
    host.robust_parsing = True
    said = []
    emulator.chip.receive(
        dialect().MAVLink_hello_message(dialect().ARMSIGHT_DIALECT_VERSION, c.CONFIG_VERSION, 7).pack(host)
    )
    for tick in range(60):
        if tick < 40:
            emulator.chip.count("TIM2", 5)
            sensor.values[AbsoluteSensor.ANGLE] += 20
        for message in host.parse_buffer(emulator.millisecond()) or []:
            said.append(message)
    angles = [message for message in said if message.get_type() == "ANGLES"][-1].angle_rad
    assert angles[0] == pytest.approx(2.0 * math.pi * 195 / PER_REV, abs=2.0 * math.pi * 6 / PER_REV)
    assert angles[1] == pytest.approx(2.0 * math.pi * 800 / 16384, abs=1e-5)
    assert emulator.chip.wrongs == []
