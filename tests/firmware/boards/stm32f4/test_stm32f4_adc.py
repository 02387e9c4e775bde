"""The Nucleo's converter driver: a scan's order and times, sixteen readings added up, a converter that stands still."""

import math

import pytest
from firmware_layout import c
from hypothesis import given, settings
from hypothesis import strategies as st
from stm32f4_build import COMPILERS, fresh
from stm32f4_emulator import RAM
from stm32f4_registers import ADC_CHANNEL

POT_PINS = ("PC0", "PC1", "PC2", "PC3", "PC4", "PC5")
CURRENT_PINS = ("PA0", "PA1", "PA4", "PA7", "PB0", "PB1")
SUPPLY_PIN = "PA5"
AT = RAM + 64
OPEN = 65535


def started(compiler):
    emulator = fresh(compiler)
    emulator.power_up("clock_start", "drives_start", "pins_start", "adc_start", "drives_run")
    return emulator


@pytest.fixture(params=COMPILERS)
def emulator(request):
    return started(request.param)


@pytest.fixture(scope="module", params=COMPILERS)
def shared(request):
    return started(request.param)


def read(emulator):
    """Read the converter as a tick does; return its inputs record."""
    emulator.call("adc_read", AT)
    record = c.core_inputs()
    return type(record).from_buffer_copy(emulator.uc.mem_read(AT, len(bytes(record))))


def put(emulator, levels: dict[str, int]) -> None:
    emulator.chip.levels = {ADC_CHANNEL[pin]: level for pin, level in levels.items()}


def test_a_scan_reads_currents_supply_and_potentiometers_in_this_order(emulator):
    chip = emulator.chip
    order = [ADC_CHANNEL[pin] for pin in (*CURRENT_PINS, SUPPLY_PIN, *POT_PINS)]
    assert chip.sequence() == order
    assert chip["ADC1.CR1"] == 1 << 8  # scan, 12 bits
    assert chip["ADC1.CR2"] == 1 | 3 << 8 | 14 << 24 | 1 << 28  # on, DMA for ever, TIM8's trigger rising, right-aligned


def test_the_converter_is_not_driven_beyond_its_datasheet(emulator):
    """At most 36 MHz; a scan ends before the next trigger; a source of 10 kOhm settles to a quarter of a bit.

    Datasheet of the STM32F446, equation 1: R = (k - 0.5) / (f C ln 2^(12+2)) - R_switch, where C is 7 pF and R_switch
    6 kOhm at most.
    """
    chip = emulator.chip
    clock = chip.apb2()[0] / (2, 4, 6, 8)[chip["ADC.CCR"] >> 16 & 3]
    assert clock == 22.5e6
    sampling = [chip.sampling(channel) for channel in chip.sequence()]
    assert sum(clocks + 12 for clocks in sampling) / clock < 1 / 20e3
    for clocks in sampling:
        assert (clocks - 0.5) / (clock * 7e-12 * 14 * math.log(2.0)) - 6e3 > 10e3


@given(levels=st.lists(st.integers(0, 4095), min_size=13, max_size=13))
@settings(max_examples=20)
def test_sixteen_readings_make_a_16_bit_fraction(shared, levels):
    pins = (*POT_PINS, *CURRENT_PINS, SUPPLY_PIN)
    put(shared, dict(zip(pins, levels, strict=True)))
    shared.chip.scans(20)
    inputs = read(shared)
    assert list(inputs.counts) == [16 * level for level in levels[:6]]
    assert list(inputs.current_ma) == [16 * level * 3000 >> 16 for level in levels[6:12]]
    assert inputs.supply_mv == 16 * levels[12] * 69300 >> 16
    assert shared.chip.wrongs == []


def test_the_last_sixteen_readings_count_and_no_older_ones(emulator):
    put(emulator, dict.fromkeys(POT_PINS, 4095))
    emulator.chip.scans(30)
    sums = []
    for level in (100, 101, 103, 107):
        put(emulator, dict.fromkeys(POT_PINS, level))
        emulator.chip.scans(4)
    sums.append(list(read(emulator).counts))
    put(emulator, dict.fromkeys(POT_PINS, 200))
    emulator.chip.scans(8)
    sums.append(list(read(emulator).counts))
    assert sums == [[4 * (100 + 101 + 103 + 107)] * 6, [4 * (103 + 107) + 8 * 200] * 6]


def test_a_reading_in_the_middle_of_a_scan_is_whole(emulator):
    """The scan under way has replaced some channels' oldest reading and not yet the others': each sum is of sixteen."""
    put(emulator, dict.fromkeys(POT_PINS, 1000))
    emulator.chip.scans(16)
    put(emulator, dict.fromkeys(POT_PINS, 2000))
    emulator.chip.conversions(10)  # three potentiometers read anew
    assert list(read(emulator).counts) == [17000] * 3 + [16000] * 3


def test_a_converter_that_stands_still_reads_open_and_is_started_again(emulator):
    chip = emulator.chip
    put(emulator, dict.fromkeys(POT_PINS, 1000))
    chip.scans(20)
    assert list(read(emulator).counts) == [16000] * 6
    chip["ADC1.SR"] |= 1 << 5  # an overrun: no request of the converter follows
    chip.scans(20)
    assert list(read(emulator).counts) == [OPEN] * 6
    assert chip["ADC1.SR"] == 0
    assert chip["DMA2.S0NDTR"] == 16 * 13
    chip.scans(20)
    assert list(read(emulator).counts) == [16000] * 6
    assert chip.wrongs == []


def test_it_is_started_again_from_the_first_channel_in_the_middle_of_a_scan(emulator):
    chip = emulator.chip
    chip.scans(16)
    read(emulator)
    put(emulator, {pin: 100 + i for i, pin in enumerate(POT_PINS)})
    chip.conversions(5)
    assert list(read(emulator).counts) == [OPEN] * 6
    chip.scans(20)
    assert list(read(emulator).counts) == [16 * (100 + i) for i in range(6)]


def test_no_motor_current_in_full_scale_is_beyond_32_bits(emulator):
    put(emulator, dict.fromkeys((*CURRENT_PINS, SUPPLY_PIN), 4095))
    emulator.chip.scans(20)
    inputs = read(emulator)
    assert list(inputs.current_ma) == [2999] * 6
    assert inputs.supply_mv == 65520 * 69300 // 65536  # 69.3 V full scale: the product needs 33 bits
