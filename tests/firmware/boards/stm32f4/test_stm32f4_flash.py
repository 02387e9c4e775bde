"""The Nucleo's stored configurations: two sectors, erased and programmed as the manual says, and read back."""

import ctypes

import numpy as np
import pytest
from firmware_layout import c
from stm32f4_build import COMPILERS, fresh
from stm32f4_emulator import FLASH, RAM

SECTORS = (FLASH + 0x4000, FLASH + 0x8000)
SIZE = ctypes.sizeof(c.config_copy)
AT = RAM + 64


@pytest.fixture(params=COMPILERS)
def emulator(request):
    emulator = fresh(request.param)
    emulator.power_up("watchdog_set_long", "clock_start", "watchdog_set_short")
    return emulator


def store(emulator, which: int, data: bytes) -> bool:
    emulator.uc.mem_write(AT, data)
    return bool(emulator.call("flash_write", which, AT) & 1)


def noise(seed: int) -> bytes:
    return np.random.default_rng(seed).bytes(SIZE)


@pytest.mark.parametrize("which", [0, 1])
def test_a_copy_is_erased_programmed_and_read_back(emulator, which):
    chip = emulator.chip
    others = bytes(emulator.uc.mem_read(FLASH, 0x80000))
    assert store(emulator, which, noise(1))
    assert store(emulator, which, noise(2))  # over what was there
    emulator.call("flash_read", which, AT)
    assert bytes(emulator.uc.mem_read(AT, SIZE)) == noise(2)
    assert chip.wrongs == []
    now = bytearray(emulator.uc.mem_read(FLASH, 0x80000))
    offset = SECTORS[which] - FLASH
    now[offset : offset + SIZE] = b"\xff" * SIZE
    assert bytes(now) == others


def test_the_memory_is_locked_again_and_its_cache_emptied(emulator):
    chip, before = emulator.chip, len(emulator.chip.writes)
    assert store(emulator, 0, noise(3))
    done = chip.writes[before:]
    flash = [(name, value) for name, value in done if name.startswith("FLASH")]
    assert flash[:3] == [("FLASH.KEYR", 0x45670123), ("FLASH.KEYR", 0xCDEF89AB), ("FLASH.SR", 0x1F2)]
    assert flash[3:6] == [
        ("FLASH.CR", 0x20A),
        ("FLASH.CR", 0x1020A),
        ("FLASH.CR", 0x201),
    ]  # sector 1, start, program words
    assert flash[6] == ("FLASH.CR", 1 << 31)
    # The data cache is reset while it is off, and on again.
    assert [value >> 8 & 0x1F for _, value in flash[7:]] == [0b00011, 0b10011, 0b00011, 0b00111]
    assert chip["FLASH.CR"] >> 31 == 1


def test_the_watchdog_waits_for_the_erase_and_is_short_again_after(emulator):
    """An erase takes 0.5 s at most (datasheet, 16 KB at 32 bits), a word 100 us; its oscillator may run at 47 kHz."""
    chip = emulator.chip
    seen = []
    erase = chip.set_flash_cr
    chip.set_flash_cr = lambda name, value: (seen.append(chip.watchdog_ms()), erase(name, value))
    assert store(emulator, 1, noise(4))
    assert min(seen) * 32 / 47 > 500 + 0.1 * SIZE / 4
    assert chip.watchdog_ms() == 10.0


def test_no_interrupt_is_taken_while_the_memory_cannot_be_read(emulator):
    masked = []
    erase = emulator.chip.set_flash_cr
    emulator.chip.set_flash_cr = lambda name, value: (masked.append(emulator.masked()), erase(name, value))
    assert store(emulator, 0, noise(5))
    assert set(masked) == {True}
    assert not emulator.masked()


def test_a_cell_that_cannot_be_written_is_reported(emulator):
    """The sector is worn: by the time it is locked a word stands as the erase left it."""
    chip, write = emulator.chip, emulator.chip.set_flash_cr

    def worn(name, value):
        write(name, value)
        if value >> 31:
            chip.memory_write(SECTORS[0] + 40, b"\xff" * 4)

    chip.set_flash_cr = worn
    assert not store(emulator, 0, noise(6))
    assert chip["FLASH.CR"] >> 31 == 1
