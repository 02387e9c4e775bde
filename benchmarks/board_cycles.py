"""Cycles of the tick by an honest estimate, beside the count of instructions: loads, divisions, branches, wait states.

    python benchmarks/board_cycles.py          both compilers, needs arm-none-eabi-objdump

The image runs on Unicorn, and what each instruction costs is taken from the Cortex-M4's Technical Reference Manual (DDI
0439, tables 3-1 and 7-1), from ``least`` to ``most``; ``likely`` is what follows from the instructions beside it:

    data processing, multiplication, moves    1
    load                                      1 to 2, likely 1 behind another load; pairs 2 to 3, N registers 1 + N
    store                                     1 to 2, likely 1 (the write buffer), 2 behind another store
    SDIV, UDIV                                2 to 12, likely 6
    float arithmetic                          1 to 2, likely 2 where the next instruction names the result; VMLA 3 to 4
    VDIV, VSQRT                               14 to 15, likely as other float arithmetic
    branch taken                              2 to 4, likely 3
    entry and exit of the interrupt           12 + 12, and 18 + 18 for the registers of the floating-point unit

At 100 MHz the flash memory of STM32F411 and F446 makes wait 3 cycles (reference manuals RM0383 and RM0390). ``least`` has
every line in the ART accelerator; ``most`` waits at each branch taken and each constant read; ``likely`` waits where the
line of 16 bytes is not among the last 64 of code that a branch led to, or the last 8 of constants (its sizes). Between
branches no one waits: a line holds 4 to 8 instructions, and the next one is prefetched meanwhile. RAM never waits.
"""

from __future__ import annotations

import itertools
import re
import shutil
import subprocess
import tempfile
from collections import OrderedDict
from pathlib import Path

import numpy as np

from armsight.app.board.selftest import DRIVEN, BoardTestRig
from armsight.firmware import build
from armsight.robot.board_registry import configured
from armsight.robot.boards.emulated import EmulatedLink
from armsight.sim.joints import JointPlant
from board import CLOCK_HZ, TICKS_PER_S, CountingEmulator

OBJDUMP = "arm-none-eabi-objdump"
WAIT_CYCLES, INTERRUPT_CYCLES = 3, 12 + 12 + 18 + 18
LINE_BYTES, CODE_LINES, CONSTANT_LINES = 16, 64, 8
COLUMNS = ("least", "likely", "most", "all", "loads", "stores", "divisions", "float", "taken", "constants")
AT = {name: i for i, name in enumerate(COLUMNS)}
_LINE = re.compile(r"^\s*([0-9a-f]+):\t[0-9a-f ]+\t(\S+)(?:\t([^;@]*))?(?:.*\(([0-9a-f]+) <)?")
_RANGE = re.compile(r"([rs])(\d+)-[rs](\d+)")
MANY = ("push", "pop", "ldm", "stm", "vpush", "vpop", "vldm", "vstm")
ARITHMETIC = ("vadd", "vsub", "vmul", "vnmul", "vneg", "vabs", "vcvt", "vcmp")
CHAINED = ("vmla", "vmls", "vnmla", "vnmls", "vfma", "vfms")


def kind_of(name, operands):
    """(class, least, most) of an instruction whose branch is not taken, without wait states."""
    if "{" in operands and name.startswith(MANY):
        inside = operands[operands.find("{") + 1 : operands.find("}")].split(",")
        n = sum(int(m[3]) - int(m[2]) + 1 if (m := _RANGE.search(part)) else 1 for part in inside)
        return "loads" if "pop" in name or "ld" in name else "stores", 1 + n, 1 + n
    if name.startswith(("ldrd", "strd")):
        return "loads" if name[0] == "l" else "stores", 2, 3
    if name.startswith(("ldr", "vldr")):
        return "constants" if "[pc" in operands else "loads", 1, 2
    if name.startswith(("str", "vstr")):
        return "stores", 1, 2
    if name.startswith(("sdiv", "udiv")):
        return "divisions", 2, 12
    if name.startswith(("vdiv", "vsqrt")):
        return "divisions", 14, 15
    if name.startswith(CHAINED):
        return "float", 3, 4
    return ("float", 1, 2) if name.startswith(ARITHMETIC) else ("all", 1, 1)


def likely(kind, least, most, operands, before, after):
    """What an instruction costs between its neighbours: the class of the one before, the operands of the one behind."""
    if least == most:
        return most
    if (least, most) == (2, 12):
        return 6
    if kind in ("loads", "constants"):
        return least if before in ("loads", "constants") else most
    if kind == "stores":
        return most if before == "stores" else least
    result = operands.split(",")[0].strip()
    return most if result and re.search(rf"\b{result}\b", after) else least


def listing(image):
    """Address -> (name, operands) of every instruction of an image."""
    text = subprocess.run([OBJDUMP, "-d", str(image)], capture_output=True, text=True, check=True).stdout
    found = (_LINE.match(line) for line in text.splitlines())
    return {int(m[1], 16): (m[2].split(".")[0], (m[3] or "").strip()) for m in found if m}


class Lines:
    """The last lines of the flash memory that were read."""

    def __init__(self, size):
        self.size, self.held = size, OrderedDict()

    def wait(self, address):
        """Read an address; returns the cycles that it waits."""
        line = address // LINE_BYTES
        known = line in self.held
        self.held[line] = True
        self.held.move_to_end(line)
        if len(self.held) > self.size:
            self.held.popitem(last=False)
        return 0 if known else WAIT_CYCLES


class CycleEmulator(CountingEmulator):
    """Counts a tick's cycles: each of ``ticks`` is a row of COLUMNS."""

    def __init__(self, elf):
        self.code, self.kinds, self.ticks, self.ended = {}, {}, [], 0
        self.sums = np.zeros(len(COLUMNS), dtype=int)
        self.lines, self.constants = Lines(CODE_LINES), Lines(CONSTANT_LINES)
        super().__init__(elf)

    def _block(self, address, size):
        """The row of a block, no line waited for but at most, and the addresses of the constants that it reads."""
        row, before, constants = np.zeros(len(COLUMNS), dtype=int), "", []
        here = [at for at in range(address, address + size, 2) if at in self.code]
        for at, behind in itertools.zip_longest(here, here[1:]):
            name, operands = self.code[at]
            kind, least, most = kind_of(name, operands)
            after = "" if behind is None else self.code[behind][1]
            row[:3] += least, likely(kind, least, most, operands, before, after), most
            row[AT["all"]] += 1
            row[AT[kind]] += kind != "all"
            if kind == "constants":
                row[AT["most"]] += WAIT_CYCLES
                offset = re.search(r"#(-?\d+)", operands)
                constants.append((at + 4) // 4 * 4 + int(offset[1] if offset else 0))
            before = kind
        return row, constants

    def _count(self, uc, address, size, user):
        super()._count(uc, address, size, user)
        key = (address, size)
        if key not in self.kinds:
            self.kinds[key] = self._block(address, size)
        row, constants = self.kinds[key]
        self.sums += row
        for each in constants:
            self.sums[AT["likely"]] += self.constants.wait(each)
        if address != self.ended:  # a branch led here
            self.sums[:3] += 1, 2 + self.lines.wait(address), 3 + WAIT_CYCLES
            self.sums[AT["taken"]] += 1
        self.ended = address + size

    def _call(self, address):
        self.sums[:] = 0
        super()._call(address)
        if address == self._symbols["pil_control"] | 1:
            self.ticks.append(self.sums.copy())


def main():
    if shutil.which(OBJDUMP) is None:
        raise SystemExit(f"{OBJDUMP} is not installed: apt-get install binutils-arm-none-eabi")
    print(f"{'':28}" + "".join(f"{name:>10}" for name in COLUMNS))
    with tempfile.TemporaryDirectory() as folder:
        for name, compiler in build.compilers().items():
            image = build.build_board("pil", Path(folder) / f"{name}.elf", compiler)
            ticks = []
            for scenario in ("nominal", "gain_change"):
                emulator, plant = CycleEmulator.open(image), JointPlant()
                emulator.code = listing(image)
                link = EmulatedLink(emulator, plant)
                configured(link)
                emulator.ticks.clear()
                DRIVEN[scenario](BoardTestRig.connect(link, plant, []))
                ticks += emulator.ticks
                link.close()
            rows = np.array(ticks)
            rows[:, :3] += INTERRUPT_CYCLES
            share = CLOCK_HZ / TICKS_PER_S
            for what, row in (("mean", rows.mean(0)), ("the longest tick", rows[rows[:, AT["likely"]].argmax()])):
                print(f"{name:6}{what:22}" + "".join(f"{each:10.0f}" for each in row))
                print(f"{'':28}" + "".join(f"{each / share:10.1%}" for each in row[:4]) + "  of 100 MHz")


if __name__ == "__main__":
    main()
