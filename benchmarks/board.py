"""The board's five metrics: speed, cost of a tick, the fault campaign, the control law against float64, static checks.

    python benchmarks/board.py             all of them, 10,000 faults: about a quarter of an hour
    python benchmarks/board.py 1000        fewer faults

Speed is measured by the clock and, beside it, by the processors' own time (this process and the emulator's), as a loaded
computer shows too little by the clock. Most of the campaign runs on the host build, whose bits are the ARM image's (the
tests hold that); a sample of it runs on the image itself, on Unicorn and on QEMU. qemu-system-arm and arm-none-eabi-gcc
are used where they are installed.
"""

from __future__ import annotations

import ctypes
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"
ROOT = Path(__file__).resolve().parent.parent
# The law in float64 is the tests' own.
sys.path[:0] = [str(ROOT / "tests" / part) for part in ("firmware/core", "firmware", "")]

import firmware_arm  # noqa: E402
import numpy as np  # noqa: E402
import test_firmware_pid as pid_tests  # noqa: E402
from firmware_stack import stack_use  # noqa: E402

from armsight import firmware  # noqa: E402
from armsight.app.board.selftest import DRIVEN, BoardTestRig  # noqa: E402
from armsight.firmware import build  # noqa: E402
from armsight.firmware.elf import read_elf  # noqa: E402
from armsight.robot.board_registry import configured  # noqa: E402
from armsight.robot.boards.configuration import gains_array, lab_configuration  # noqa: E402
from armsight.robot.boards.emulated import EmulatedLink  # noqa: E402
from armsight.robot.boards.emulators import (  # noqa: E402
    PROGRAM,
    UnicornEmulator,
    open_emulator,
)
from armsight.sim.joints import JointPlant  # noqa: E402
from board_faults import LINK_TICKS, Campaign, limits  # noqa: E402

SEED = 2026
CLOCK_HZ, TICKS_PER_S = 100e6, 1000
REQUIRED_SPEED = {"unicorn": 5, "qemu": 10}
SAMPLE = 300


def emulators():
    return [name for name in ("unicorn", "qemu", "host") if name != "qemu" or shutil.which(PROGRAM)]


def processor_s():
    """Processor time of this process and of those it waited for."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def paced(name, ticks, prepare, run):
    """Ticks a second by the clock and by processor time; the emulator's own counts once it has ended."""
    costs = []
    for n in (0, ticks):  # what starting costs is taken away
        link = EmulatedLink(open_emulator(name), JointPlant())
        before, begun = processor_s(), time.perf_counter()
        thing = prepare(link)
        begun = time.perf_counter()
        run(thing, link, n)
        took = time.perf_counter() - begun
        link.close()
        costs.append((took, processor_s() - before))
    return ticks / costs[1][0], ticks / (costs[1][1] - costs[0][1])


def swinging(link):
    configured(link)
    test_rig = BoardTestRig.connect(link, None, [])
    test_rig.enable()
    return test_rig


def metric_1():
    print("metric 1: lock-step with the joints' plant, ticks/s and times real time; required: unicorn 5, qemu 10")
    print(f"{'':9}{'':24}{'by the clock':>16}{'':9}{'by processor time':>20}")
    kinds = {
        "at rest": (10_000, configured, lambda _, link, n: link.step(n)),
        "driven, telemetry read": (5_000, swinging, lambda test_rig, _, n: test_rig.swing(n * 1e-3)),
    }
    for name in emulators():
        for what, (ticks, prepare, run) in kinds.items():
            clock, processor = paced(name, ticks, prepare, run)
            print(f"{name:9}{what:24}{clock:16.0f}{clock / 1000:8.1f}x{processor:20.0f}{processor / 1000:8.1f}x")


def instructions(code):
    """How many Thumb instructions a block of bytes holds: one of four bytes begins with 0b11101, 0b11110 or 0b11111."""
    count = at = 0
    while at < len(code):
        at += 4 if code[at + 1] >> 3 >= 0b11101 else 2
        count += 1
    return count


class CountingEmulator(UnicornEmulator):
    """Runs a tick's three parts one after the other and counts the instructions of each, block by block."""

    def __init__(self, elf):
        import unicorn

        self.counted, self.counts, self.blocks = 0, [], {}
        super().__init__(elf)
        self.uc.hook_add(unicorn.UC_HOOK_BLOCK, self._count)

    def _count(self, uc, address, size, _):
        if (address, size) not in self.blocks:
            self.blocks[address, size] = instructions(bytes(uc.mem_read(address, size)))
        self.counted += self.blocks[address, size]

    def tick(self, request):
        self._ram[self._request] = request
        parts = []
        for part in ("pil_begin", "pil_control", "pil_end"):
            self.counted = 0
            self._call(self._symbols[part] | 1)
            parts.append(self.counted)
        self.counts.append(parts)
        return self._ram[self._answer]


def metric_2():
    print("\nmetric 2: instructions for six joints, memory; required: a tick of at most 6 % of 100 MHz at 1 kHz")
    print(f"{'':10}{'tick mean':>11}{'max':>7}{'share':>8}{'rest mean':>11}{'max':>7}{'ms mean':>9}{'share':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for name, compiler in build.compilers().items():
            image = build.build_board("pil", Path(folder) / f"{name}.elf", compiler)
            counts = []
            for scenario in ("nominal", "gain_change"):
                emulator = CountingEmulator.open(image)
                plant = JointPlant()
                link = EmulatedLink(emulator, plant)
                configured(link)
                emulator.counts.clear()
                DRIVEN[scenario](BoardTestRig.connect(link, plant, []))
                counts += emulator.counts
                link.close()
            begin, control, end = np.array(counts).T
            rest, per_ms = begin + end, CLOCK_HZ / TICKS_PER_S
            print(
                f"{name:10}{control.mean():11.0f}{control.max():7}{control.max() / per_ms:8.2%}{rest.mean():11.0f}"
                f"{rest.max():7}{(rest + control).mean():9.0f}{(rest + control).mean() / per_ms:8.2%}"
            )
        print(
            "tick: the interrupt (sense, command, law, drive, report); its share is the greatest's. rest: the main loop"
        )
        print(
            "(wire, telemetry, a configuration read), which the tick interrupts. An instruction is counted as one cycle."
        )
        for board in build.boards():
            for name, compiler in build.compilers().items():
                elf = read_elf(build.build_board(board, Path(folder) / f"{board}-{name}.elf", compiler))
                floats = "hardware" if elf.hard_float else "SOFTWARE"
                print(
                    f"{board:9}{name:5} flash {elf.flash_bytes:6} bytes, RAM {elf.ram_bytes:6} bytes, {floats} floats"
                )
            if "gcc" in build.compilers():
                use = stack_use(board)
                print(
                    f"{'':9}stack {use.total_bytes} bytes at most (-fstack-usage): main loop {use.main.stack_bytes},"
                    f" tick {use.tick.stack_bytes}, {len(use.nested)} other interrupts, and a frame for each"
                )


def metric_3(faults):
    print(
        f"\nmetric 3: faults under motion, seed {SEED}; required: nothing violated, link again within {LINK_TICKS} ms"
    )
    for name in emulators():
        count = faults if name == "host" else min(SAMPLE, faults)
        begun = time.process_time()
        found = Campaign(open_emulator(name), SEED, limits()).run(count)
        took = time.process_time() - begun
        print(f"{name}: {count} faults in {found.ticks / 1000:.0f} s of the board ({took:.0f} s), ", end="")
        print(f"{len(found.violations)} violations")
        for violation in found.violations[:20]:
            print(f"    {violation}")
        print(f"    struck: {listed(found.faults)}")
        print(f"    reported by the right code: {listed(found.reported)}")
        print(f"    fastest joint, of its limit: {max(found.fastest.values()):.3f} ({listed(top(found.fastest))})")
        print(f"    link again, ms after the last bad byte, at most: {listed(found.slowest_link_ticks)}")
        print(
            f"    reference at rest after a fault, s, at most: {found.slowest_stop_s} (allowed {limits().stop_s:.3f})"
        )


def listed(counts):
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in counts.items()
    )


def top(values):
    return dict(Counter(values).most_common(3))


def metric_4():
    print(
        "\nmetric 4: against the same law in float64, of full scale (1 of duty, 5.2 rad of angle); required: below 1e-4"
    )
    library = firmware_arm.declare(ctypes.CDLL(str(firmware.host_library())))
    for reference, aim in pid_tests.REFERENCES.items():
        for gains_name, gains in pid_tests.GAINS.items():
            ours = pid_tests.respond(pid_tests.Pid(library, *gains, limit=0.6, slew=20.0), aim)
            law = pid_tests.respond(pid_tests.Law(*gains, limit=0.6, slew=20.0), aim)
            duty, angle = (np.abs(np.subtract(a, b)).max() for a, b in zip(ours, law, strict=True))
            print(f"{reference:10}{gains_name:13} duty {duty:.1e}  angle {angle / pid_tests.FULL_RANGE_RAD:.1e}")
    print(f"the ARM image on Unicorn, swinging: duty {replayed():.1e}")


def replayed():
    """Greatest difference of duty between the ARM image and the law in float64 given the same readings and references."""
    counts, outputs = [], []

    class Heard(JointPlant):
        def sense(self):
            sensed = super().sense()
            counts.append(sensed.counts)
            return sensed

    link = EmulatedLink(open_emulator("unicorn"), Heard())
    config = lab_configuration()
    for name in ("ka_s2_per_rad", "kf_duty"):  # the reference's acceleration is not reported
        config["joint"]["gains"][name] = 0.0
    configured(link, config)
    test_rig = BoardTestRig.connect(link, None, [])
    link._watch = lambda _: outputs.append(link.answer["outputs"].copy())
    test_rig.readings(0.2)  # both speed filters forget how they began
    test_rig.enable()
    test_rig.swing(2.0)
    link.close()
    counts = np.array(counts[-len(outputs) :])[:, 0]
    gains = gains_array(config)[0, [0, 1, 2, 3, 6, 7]]
    joint = config["joint"][0]
    law = pid_tests.Law(*gains, limit=float(joint["duty_limit"]), slew=float(joint["duty_slew_per_s"]))
    angles = -2.6 + 5.2 * (counts.astype(float) - 3277) / (62258 - 3277)
    worst, driven = 0.0, False
    law.measured = angles[0]
    for angle, output in zip(angles, outputs, strict=True):
        if not output["drives_on"]:  # only the filter of the speed runs on
            law.step(angle, 0.0, 0.0, angle)
            law.integral = law.duty = 0.0
            continue
        driven = True
        duty = law.step(float(output["reference_rad"][0]), float(output["reference_rad_s"][0]), 0.0, angle)
        worst = max(worst, abs(duty - float(output["duty"][0])))
    return worst if driven else float("nan")


def metric_5():
    print("\nmetric 5: static checks, sanitizers, fuzzer, branch coverage (tests/firmware/test_firmware_static.py)")
    command = [sys.executable, "-m", "pytest", "-q", "-rA", "--no-header", "tests/firmware/test_firmware_static.py"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    lines = [line for line in ran.stdout.splitlines() if line.startswith(("PASSED", "FAILED", "SKIPPED", "ERROR"))]
    for line in [*lines, ran.stdout.strip().splitlines()[-1]]:
        print(f"    {line.replace('tests/firmware/test_firmware_static.py::test_', '')}")


def main():
    faults = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    metric_1()
    metric_2()
    metric_3(faults)
    metric_4()
    metric_5()


if __name__ == "__main__":
    main()
