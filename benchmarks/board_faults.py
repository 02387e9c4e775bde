"""The fault campaign: seeded faults on an emulated board whose arm is in motion, each held against what must come of it.

A host of 250 Hz, or of 62.5 Hz, swings all joints; once they move, one fault strikes, most of them for a random time
log-uniformly (bytes are spoiled with the faster host only, so that it can see how soon the link is usable again):

    flip, drop, burst    bytes to the board or to the host: one bit changed; 1 to 20 bytes missing; noise for 1 to 30 ms
    stall                the host sends nothing for 1 ms to 5 s
    pot                  a potentiometer open, shorted, frozen or jumping for 1 ms to 0.5 s; or inverted, which is a
                         mistake in the wiring: that one is made with the drives off, and then the arm is enabled
    dip                  the supply of the motors at 0 to 9 V for 1 to 50 ms
    cut                  the board itself starts anew, by a power cut or by its watchdog
    tick                 the control loop misses 1 to 20 ticks, or overruns one
    jump                 set points anywhere, any speed, to be reached within 1 to 50 ms

What must hold, with the configuration's own times (no number of this file's):

    speed      no reference is ever faster than its speed limit, and no joint (its true speed, not the measured one)
               faster than that by more than a tenth: a joint that is commanded to move at its limit catches up with it
    stop       a fault that releases switches the drives off, one of a joint that joint's; the other references come to
               rest within speed limit / deceleration and a tenth of a second; half a second later nothing moves at a
               twentieth of its limit
    code       a fault that lasts long enough is reported by its own code and joint, a shorter one is not reported at all
    link       a command sent after the last bad byte is acknowledged, and telemetry read, within 20 ms of it
    known      afterwards the host's last acknowledged and rejected numbers are the board's
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from armsight.data import JointCommand
from armsight.errors import DeviceError
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import BoardState, Command, Fault, Rejection
from armsight.robot.boards.configuration import lab_configuration
from armsight.robot.boards.emulated import EmulatedLink
from armsight.sim.joints import JointPlant, PotFault

PERIODS = (4, 16)  # ticks
CATCHING_UP, STANDING = 1.1, 0.05  # of the speed limit
LINK_TICKS = 20
SETTLE_S = 0.1
KINDS = ("flip", "drop", "burst", "stall", "pot", "dip", "cut", "tick", "jump")
POT_CODES = {
    PotFault.OPEN: Fault.POT_OPEN,
    PotFault.SHORT: Fault.POT_SHORT,
    PotFault.FROZEN: Fault.POT_FROZEN,
    PotFault.JUMP: Fault.POT_JUMP,
    PotFault.INVERTED: Fault.POT_INVERTED,
}
#: Faults that hold the arm instead of switching its drives off.
HELD = (Fault.HOST_SILENT, Fault.TICK_MISSED, Fault.TICK_OVERRUN)


class Noise:
    """What the wire does to bytes: nothing until it is set to strike."""

    def __init__(self, rng):
        self.rng, self.kind, self.to_host_side, self.until, self.last_bad = rng, None, False, 0, None

    def strike(self, kind, to_host_side, until):
        self.kind, self.to_host_side, self.until, self.last_bad = kind, to_host_side, until, None

    def to_board(self, tick, data):
        return data if self.to_host_side else self._spoil(tick, data)

    def to_host(self, tick, data):
        return self._spoil(tick, data) if self.to_host_side else data

    def _spoil(self, tick, data):
        if self.kind is None:
            return data
        if self.kind == "burst":
            if tick > self.until:
                self.kind = None
                return data
            self.last_bad = tick
            return self.rng.bytes(int(self.rng.integers(1, 90)))
        if not data:
            return data
        spoiled, at = bytearray(data), int(self.rng.integers(len(data)))
        if self.kind == "flip":
            spoiled[at] ^= 1 << int(self.rng.integers(8))
        else:
            del spoiled[at : at + int(self.rng.integers(1, 21))]
        self.kind, self.last_bad = None, tick
        return bytes(spoiled)


@dataclass
class Outcome:
    """What the campaign found."""

    faults: Counter = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)
    reported: Counter = field(default_factory=Counter)
    fastest: dict = field(default_factory=dict)  # by kind, share of the speed limit
    slowest_link_ticks: dict = field(default_factory=dict)  # by kind and side
    slowest_stop_s: float = 0.0
    ticks: int = 0


class Campaign:
    """A host, a board and an arm, and a fault at a time."""

    def __init__(self, emulator, seed, limits):
        self.rng = np.random.default_rng(seed)
        self.limits = limits
        self.plant = JointPlant(seed=seed)
        self.noise = Noise(self.rng)
        self.link = EmulatedLink(emulator, self.plant, faults=self.noise, watch=self._watch)
        self.out = Outcome()
        self.kind = "none"
        self.reference, self.rate = np.zeros(6), np.zeros(6)
        self.phase_s = 0.0
        self.fault_tick = None  # when one latched
        self.fault_was = 0
        self.rest_tick = None
        self.acknowledged_after = None  # (sequence that counts, tick in which one was acknowledged)
        self.outputs = None
        self.period_ticks = PERIODS[0]
        self.sent = 0  # number of the last motion command
        self.config = lab_configuration()
        board = Board.connect(self.link)
        board.store(self.config)
        self.link.restart()
        self.board = Board.connect(self.link)

    def violate(self, what):
        self.out.violations.append(f"fault {sum(self.out.faults.values())} ({self.kind}): {what}")

    # What is looked at in every tick.

    def _watch(self, _answer):
        outputs = self.link.answer["outputs"]
        self.outputs = outputs
        self.out.ticks += 1
        fastest = float(np.abs(self.plant.qd).max()) / self.limits.speed_rad_s
        if fastest > self.out.fastest.get(self.kind, 0.0):
            self.out.fastest[self.kind] = fastest
            if fastest > CATCHING_UP:
                self.violate(f"a joint moves at {fastest:.3f} of its limit")
        speed = float(np.abs(outputs["reference_rad_s"]).max()) / self.limits.speed_rad_s
        self.out.fastest["reference"] = max(speed, self.out.fastest.get("reference", 0.0))
        if speed > 1.0 + 1e-6:
            self.violate(f"a reference moves at {speed:.3f} of its limit")
        tick = int(outputs["tick"])
        if outputs["faults"] and not self.fault_was:
            self.fault_tick, self.rest_tick = tick, None
        self.fault_was = int(outputs["faults"])
        if self.fault_was and self.rest_tick is None and not np.any(outputs["reference_rad_s"]):
            self.rest_tick = tick
        waiting = self.acknowledged_after is not None and self.acknowledged_after[1] is None
        if waiting and int(outputs["acknowledged_sequence"]) > self.acknowledged_after[0]:
            self.acknowledged_after = (self.acknowledged_after[0], tick)

    # The host.

    def command(self):
        """Return the next command on the way to a swing of all joints, 1.5 rad/s at most, without a jolt."""
        self.phase_s += self.period_s
        target = 0.6 * np.sin(2 * math.pi * (0.4 * self.phase_s + np.arange(6) / 6))
        speed_ref = np.clip((target - self.reference) / 0.1, -1.5, 1.5)
        self.rate = self.rate + np.clip(speed_ref - self.rate, -10.0 * self.period_s, 10.0 * self.period_s)
        self.reference = self.reference + self.rate * self.period_s
        return JointCommand(self.reference, self.rate, np.zeros(6), self.period_s)

    @property
    def period_s(self):
        return self.period_ticks * 1e-3

    def take_up(self):
        """Go on from where the board has its references."""
        self.reference = np.array(self.board.joints.reference_rad)
        self.rate = np.array(self.board.joints.reference_rad_s)

    def period(self, send=True):
        """One period of the host: a command, and what it takes; returns what came."""
        if send:
            self.sent = self.board.send(self.command())
        return self.board.receive(self.period_s)

    def periods(self, ticks, send=True):
        for _ in range(math.ceil(ticks / self.period_ticks)):
            self.period(send)

    def ready(self):
        """Bring the arm into motion, out of whatever the last fault left."""
        for _ in range(100):
            state = self.board.status.state
            if state == BoardState.ENABLED and not self.board.status.faults:
                break
            clean = not self.board.status.faults and state in (BoardState.DISABLED, BoardState.HOLDING)
            self.board.command(Command.ENABLE if clean else Command.CLEAR_FAULTS)
            self.board.receive(0.02)
            self.take_up()
        else:
            self.violate(f"the arm cannot be enabled again: {self.board.status}")
        self.periods(int(self.rng.integers(80, 160)))
        for _ in range(500):
            if np.abs(self.plant.qd).max() > 0.2:
                break
            self.period()
        else:
            self.violate("the arm cannot be brought into motion")
        if self.fault_was:
            self.violate(f"fault {self.outputs['first_fault']} before the next one strikes")

    # The faults.

    def run(self, faults):
        for _ in range(faults):
            kind = str(self.rng.choice(KINDS))
            self.period_ticks = PERIODS[0] if kind in ("flip", "drop", "burst") else int(self.rng.choice(PERIODS))
            self.kind = "between"
            self.ready()
            self.kind = kind
            self.out.faults[self.kind] += 1
            getattr(self, f"do_{self.kind}")()
            self.kind = "after"
            self.known()
        return self.out

    def do_flip(self):
        self.bytes_spoiled(1)

    def do_drop(self):
        self.bytes_spoiled(1)

    def do_burst(self):
        self.bytes_spoiled(int(self.rng.integers(1, 31)))

    def bytes_spoiled(self, ticks):
        to_host_side = bool(self.rng.integers(2))
        before, broken = self.board.status, self.board.broken_messages
        self.noise.strike(self.kind, to_host_side, int(self.outputs["tick"]) + ticks)
        while self.noise.kind is not None:
            self.period()
        bad = self.noise.last_bad
        self.acknowledged_after = (self.sent, None)
        heard_tick = None
        for _ in range(12):
            states = self.period()
            newest = round(states.t_s[-1] * 1000) if len(states.t_s) else 0
            if heard_tick is None and newest > bad:
                heard_tick = int(self.outputs["tick"])
        acknowledged_tick = self.acknowledged_after[1]
        self.acknowledged_after = None
        side = "to host" if to_host_side else "to board"
        found = heard_tick if to_host_side else acknowledged_tick
        late = (found - bad) if found is not None else 999
        key = f"{self.kind} {side}"
        self.out.slowest_link_ticks[key] = max(self.out.slowest_link_ticks.get(key, 0), late)
        if late > LINK_TICKS:
            self.violate(f"link {side} usable again {late} ms after the last bad byte")
        self.expect_no_fault()
        self.periods(30)
        after = self.board.status
        counted = (
            self.board.broken_messages - broken
            if to_host_side
            else (after.crc_errors + after.lost_bytes - before.crc_errors - before.lost_bytes)
        )
        if not counted:
            self.violate(f"spoiled bytes {side} were not counted")

    def lasting(self, low, high):
        """A time in ms, log-uniform."""
        return round(math.exp(self.rng.uniform(math.log(low), math.log(high))))

    def do_stall(self):
        ticks = self.lasting(1, 5000)
        self.board.receive(ticks * 1e-3)
        silence = int(self.config["silence_ticks"])
        # The last command arrives up to a period after it was sent.
        if ticks > silence + self.period_ticks:
            self.expect_fault(Fault.HOST_SILENT, None)
            self.periods(500, send=False)
            self.expect_rest()
        elif ticks < silence - self.period_ticks:
            self.periods(20)
            self.expect_no_fault()

    def do_pot(self):
        joint, broken = int(self.rng.integers(6)), PotFault(int(self.rng.integers(1, 6)))
        ticks = self.lasting(1, 500)
        self.kind = f"pot {broken.name}"
        if broken == PotFault.INVERTED:
            self.rewire()
            ticks = 500
        self.plant.break_pot(joint, broken)
        if broken == PotFault.INVERTED:
            self.board.confirm(self.board.command(Command.ENABLE))
        start_rad, travel_rad = float(self.outputs["reference_rad"][joint]), 0.0
        for _ in range(ticks):
            self.one_tick()
            travel_rad = max(travel_rad, abs(float(self.outputs["reference_rad"][joint]) - start_rad))
            if self.fault_was:
                break
        self.plant.break_pot(joint, PotFault.NONE)
        reported_at_once = broken in (PotFault.OPEN, PotFault.SHORT, PotFault.JUMP)
        # The board begins to count with the last reading that changed, and compares a reference a tick after it was there.
        far_rad = self.config["joint"]["pot"]["frozen_rad"][joint] + 2e-3 * self.limits.speed_rad_s
        far_enough = broken == PotFault.FROZEN and travel_rad > far_rad
        must = (
            broken == PotFault.INVERTED or far_enough or (reported_at_once and ticks >= int(self.config["pot_ticks"]))
        )
        if self.fault_was or must:
            self.expect_fault(POT_CODES[broken], joint)
            self.periods(500, send=False)
            self.expect_rest()

    def rewire(self):
        """Bring the arm to rest with its drives off, for what nobody does to a moving one."""
        self.board.confirm(self.board.command(Command.DISABLE))
        self.board.receive(1.0)
        self.take_up()

    def one_tick(self):
        """One tick, in the middle of the host's own beat."""
        if int(self.outputs["tick"]) % self.period_ticks == 0:
            self.sent = self.board.send(self.command())
        self.board.receive(1e-3)

    def do_dip(self):
        ticks, whole_mv = self.lasting(1, 50), self.plant.supply_mv
        self.plant.supply_mv = int(self.rng.integers(0, 9001))
        for _ in range(ticks):
            self.one_tick()
        self.plant.supply_mv = whole_mv
        if ticks >= int(self.config["supply_ticks"]):
            self.expect_fault(Fault.SUPPLY_LOW, None)
            self.periods(500, send=False)
            self.expect_rest()
        else:
            self.periods(40)
            self.expect_no_fault()

    def do_cut(self):
        """The board starts anew: drives off, and the host hears nothing more until it says hello again."""
        watchdog = bool(self.rng.integers(2))
        self.kind = "cut by watchdog" if watchdog else "cut"
        self.link.restart(watchdog=watchdog)
        rejection = None
        try:
            self.periods(1200)
        except DeviceError as error:
            rejection = error
        if rejection is None:
            self.violate("a board that started anew is not noticed")
        on = bool(self.outputs["drives_on"])
        self.link.step(500)
        if on or self.outputs["drives_on"] or np.abs(self.plant.qd).max() > STANDING * self.limits.speed_rad_s:
            self.violate("the arm is driven by a board that started anew")
        self.board = Board.connect(self.link)
        self.take_up()
        if watchdog:
            self.expect_fault(Fault.WATCHDOG, None)

    def do_tick(self):
        missed = int(self.rng.integers(0, 21))
        self.kind = "tick missed" if missed else "tick overrun"
        self.link.miss(missed) if missed else self.link.overrun()
        self.one_tick()
        self.expect_fault(Fault.TICK_MISSED if missed else Fault.TICK_OVERRUN, None)
        self.periods(500, send=False)
        self.expect_rest()

    def do_jump(self):
        for _ in range(int(self.rng.integers(1, 40))):
            far, fast = self.rng.uniform(-3, 3, 6), self.rng.uniform(-5, 5, 6)
            command = JointCommand(far, fast, np.zeros(6), int(self.rng.integers(1, 51)) * 1e-3)
            self.board.send(command)
            self.board.receive(self.period_s)
        self.board.receive(0.012)
        self.take_up()
        self.periods(200)
        self.expect_no_fault()

    # What must come of them.

    def expect_no_fault(self):
        if self.fault_was:
            self.violate(f"fault {self.outputs['first_fault']} though nothing lasted long enough for one")

    def expect_fault(self, fault, joint):
        self.board.receive(0.03)
        first = self.board.status.first_fault
        if first is None or (first.fault, first.joint) != (fault, joint):
            self.violate(f"{fault.name} of joint {joint} is reported as {first}")
        else:
            self.out.reported[fault.name] += 1
        released = not self.outputs["drives_on"] if joint is None else not self.outputs["duty"][joint]
        if fault not in HELD and not released:
            self.violate(f"{fault.name} leaves the drives on")

    def expect_rest(self):
        if self.fault_tick is None or self.rest_tick is None:
            self.violate("the reference never comes to rest after a fault")
            return
        took_s = (self.rest_tick - self.fault_tick) * 1e-3
        self.out.slowest_stop_s = max(self.out.slowest_stop_s, took_s)
        if took_s > self.limits.stop_s:
            self.violate(f"the reference comes to rest after {took_s} s")
        if np.abs(self.plant.qd).max() > STANDING * self.limits.speed_rad_s:
            self.violate(
                f"a joint still moves at {np.abs(self.plant.qd).max():.2f} rad/s half a second after the fault"
            )

    def known(self):
        self.periods(40, send=not self.fault_was)
        self.periods(30, send=False)
        status, core = self.board.status, self.outputs
        if status.acknowledged_sequence != int(core["acknowledged_sequence"]):
            self.violate(
                f"host knows {status.acknowledged_sequence} as acknowledged last, the core {core['acknowledged_sequence']}"
            )
        of_core = status.rejection != Rejection.NO_HELLO  # the wire rejects those by itself
        if of_core and status.rejected_sequence != int(core["rejected_sequence"]):
            self.violate(
                f"host knows {status.rejected_sequence} as rejected last, the core {core['rejected_sequence']}"
            )


@dataclass(frozen=True)
class Limits:
    """What the configuration allows."""

    speed_rad_s: float
    stop_s: float


def limits():
    joint = lab_configuration()["joint"][0]
    # Beside the braking itself the deceleration has to come and to go.
    stop_s = float(joint["speed_limit_rad_s"] / joint["deceleration_rad_s2"]) + SETTLE_S
    return Limits(float(joint["speed_limit_rad_s"]), stop_s)
