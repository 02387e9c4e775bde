"""Faults that the firmware has no code for, on the arms of board_arms.py and the firmware's core: what it makes of them.

    python benchmarks/board_unforeseen.py 40 --seed 5001 [--only tooth]

``named``: one of the codes that a person who sees the part would accept, or no fault where the arm went on within its
limits and nothing asks for one; ``beside``: it is latched beside others; ``wrong``: others alone, or of another joint.
``fast``: true speed of the joint over its limit while it is driven (released, it sinks as
shorted windings let it); ``ran``: beyond 1.1 and still driven 60 ms later.
"""

from __future__ import annotations

import argparse
import ctypes
from collections import Counter, defaultdict

import numpy as np

from board_arms import NAMED_TICKS, PERIOD_TICKS, Fault, c, opened
from board_motors import ASLEEP_MS, SPEED, drawn_arm, until_moving

POTS = {fault for fault in Fault if fault.name.startswith("POT_")}
LOADS = {Fault.OVERLOAD, Fault.STALL, Fault.FOLLOWING, Fault.PUSHED}
LOOK_TICKS, TICK = 4000, ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


class Broken:
    """Stands between core and plant: ``reads`` changes what the core takes, ``drives`` what it put out."""

    accepted: frozenset = frozenset()  # codes; silence is accepted, too, unless ``must`` says otherwise
    must = False

    def __init__(self, arm, joint, rng):
        self.arm, self.joint, self.rng, self.on = arm, joint, rng, False
        self.plant, self.model = arm.plant, arm.plant._model
        core_tick = TICK(arm.loop.core_tick)

        def tick(core, inputs, outputs):
            if self.on:
                self.reads(arm.inputs)
            core_tick(core, inputs, outputs)
            if self.on:
                self.drives(arm.outputs)

        self.kept = TICK(tick)
        arm.loop.core_tick = ctypes.cast(self.kept, ctypes.c_void_p).value
        self.draw()

    def draw(self):
        """Draw how large it is."""

    def reads(self, inputs):
        """Change what the core takes in this tick."""

    def drives(self, outputs):
        """Change what reaches the motors in this tick."""

    @property
    def rad(self):
        return float(self.plant.link[self.joint])

    def put(self, inputs, counts):
        inputs.counts[self.joint] = int(np.clip(round(counts / 4) * 4, 0, 65535))


class HalfBridgeReversed(Broken):
    """The PWM of one half-bridge has the wrong sign: one direction of duty drives the other way."""

    accepted = frozenset({Fault.BRIDGE})  # or silence: a direction that is not used shows nothing

    def draw(self):
        self.sign = self.rng.choice([-1, 1])

    def drives(self, outputs):
        if outputs.duty[self.joint] * self.sign > 0:
            outputs.duty[self.joint] *= -1


class HalfBridgeDead(HalfBridgeReversed):
    """One half-bridge never switches: one direction of duty drives nothing."""

    accepted = frozenset({Fault.BRIDGE, Fault.CURRENT_SENSOR})

    def drives(self, outputs):
        if outputs.duty[self.joint] * self.sign > 0:
            outputs.duty[self.joint] = 0.0


class BridgeLate(Broken):
    """A driver that puts out the duty of 4 to 10 ms ago."""

    accepted = frozenset({Fault.BRIDGE, Fault.OSCILLATION, Fault.CURRENT_SENSOR})

    def draw(self):
        self.queue = [0.0] * int(self.rng.integers(4, 11))

    def drives(self, outputs):
        self.queue.append(outputs.duty[self.joint])
        outputs.duty[self.joint] = self.queue.pop(0)


class WiperLifts(Broken):
    """The wiper loses its track over 0.01 to 0.1 rad: a pull-up lifts the reading."""

    accepted = frozenset({Fault.POT_OPEN, Fault.POT_JUMP})

    def draw(self):
        self.at, self.half = self.rad + self.rng.uniform(-0.3, 0.3), self.rng.uniform(0.005, 0.05)

    def reads(self, inputs):
        if abs(self.rad - self.at) < self.half:
            inputs.counts[self.joint] = 65535


class WiperFloats(WiperLifts):
    """The same without a pull-up: the reading creeps to mid-range with 20 ms."""

    accepted = POTS

    def draw(self):
        super().draw()
        self.seen = None

    def reads(self, inputs):
        if abs(self.rad - self.at) >= self.half or self.seen is None:
            self.seen = inputs.counts[self.joint]
        else:
            self.seen += (32768 - self.seen) * 0.05
            self.put(inputs, self.seen)


class TrackWorn(WiperLifts):
    """There the reading is noise of 300 to 2000 counts."""

    accepted = POTS

    def draw(self):
        super().draw()
        self.size = self.rng.uniform(300, 2000)

    def reads(self, inputs):
        if abs(self.rad - self.at) < self.half:
            self.put(inputs, inputs.counts[self.joint] + self.size * self.rng.normal())


class BitStuck(Broken):
    """A bit of the converter, worth 0.005 to 0.18 rad, is stuck."""

    accepted = POTS

    def draw(self):
        self.bit, self.set = 1 << int(self.rng.integers(6, 12)), bool(self.rng.integers(2))

    def reads(self, inputs):
        counts = inputs.counts[self.joint]
        inputs.counts[self.joint] = counts | self.bit if self.set else counts & ~self.bit


class NoiseOfCurrent(Broken):
    """The reading's noise grows with the motor's current: 30 to 150 counts an ampere."""

    accepted = frozenset({*POTS, Fault.OSCILLATION})

    def draw(self):
        self.per_a = self.rng.uniform(30, 150)

    def reads(self, inputs):
        amperes = abs(float(self.plant._current_a[self.joint]))
        self.put(inputs, inputs.counts[self.joint] + self.per_a * amperes * self.rng.normal())


class GroundShifts(Broken):
    """The reading moves with the motor's current: 100 to 400 counts an ampere, a ground lead shared."""

    accepted = frozenset({*POTS, Fault.OSCILLATION, Fault.FOLLOWING})

    def draw(self):
        self.per_a = self.rng.choice([-1, 1]) * self.rng.uniform(100, 400)

    def reads(self, inputs):
        self.put(inputs, inputs.counts[self.joint] + self.per_a * float(self.plant._current_a[self.joint]))


class SupplyWeak(Broken):
    """A supply of 0.2 to 1 ohm behind its sensor, under the load of all joints."""

    accepted = frozenset({Fault.SUPPLY_LOW, Fault.OVERLOAD})

    def draw(self):
        self.ohm, self.volts = self.rng.uniform(0.2, 1.0), self.plant.supply_mv * 1e-3

    def drives(self, outputs):
        duty = np.array(outputs.duty[:])
        amperes = max(float(np.sum(duty * self.plant._current_a)), 0.0)
        self.plant.supply_mv = self.arm.loop.supply_mv = round(1e3 * max(self.volts - self.ohm * amperes, 1.0))


class SupplySensorOff(Broken):
    """The supply's sensor is off by 10 to 25 %."""

    accepted = frozenset({Fault.SUPPLY_LOW, Fault.SUPPLY_HIGH, Fault.CURRENT_SENSOR, Fault.MOTOR, Fault.POT_SCALE})

    def draw(self):
        self.gain = 1 + self.rng.choice([-1, 1]) * self.rng.uniform(0.1, 0.25)

    def reads(self, inputs):
        inputs.supply_mv = round(inputs.supply_mv * self.gain)


class ToothMissing(Broken):
    """Over 0.03 to 0.08 rad of the motor nothing drives the joint: its gear has a tooth less."""

    accepted = frozenset({*POTS, *LOADS})  # what the motor does alone cannot be distinguished from a reading that slips

    def draw(self):
        self.wide, self.at = self.rng.uniform(0.03, 0.08), self.rad + self.rng.uniform(-0.3, 0.3)
        self.sound = float(self.model[6, self.joint])

    def drives(self, outputs):
        inside = abs(float(self.plant.q[self.joint]) - self.at) < 0.5 * self.wide
        self.model[6, self.joint] = self.sound + (2 * self.wide if inside else 0.0)


class BrakeDrags(Broken):
    """A brake that drags: 1 to 2.5 N m of dry friction more."""

    accepted = LOADS

    def draw(self):
        self.more = self.rng.uniform(1.0, 2.5)

    def drives(self, outputs):
        self.model[4, self.joint] += self.more
        self.more = 0.0


class Cogs(Broken):
    """A bad bearing: 0.3 to 0.8 N m that change their sign each 0.02 to 0.1 rad."""

    accepted = frozenset({*LOADS, Fault.OSCILLATION})

    def draw(self):
        self.n_m, self.wide = self.rng.uniform(0.3, 0.8), self.rng.uniform(0.02, 0.1)

    def drives(self, outputs):
        self.plant.hand_n_m[self.joint] = self.n_m * np.sin(np.pi * self.rad / self.wide)


class CurrentSaturates(Broken):
    """The current's sensor shows at most 0.2 to 1 A."""

    accepted = frozenset({Fault.CURRENT_SENSOR})

    def draw(self):
        self.most_ma = round(self.rng.uniform(200, 1000))

    def reads(self, inputs):
        inputs.current_ma[self.joint] = int(np.clip(inputs.current_ma[self.joint], -self.most_ma, self.most_ma))


class CurrentLags(Broken):
    """The current's sensor is filtered by 5 to 20 ms."""

    accepted = frozenset({Fault.CURRENT_SENSOR})

    def draw(self):
        self.ticks, self.seen = self.rng.uniform(5, 20), 0.0

    def reads(self, inputs):
        self.seen += (inputs.current_ma[self.joint] - self.seen) / self.ticks
        inputs.current_ma[self.joint] = round(self.seen)


class CurrentOneWay(Broken):
    """The current's sensor shows one direction only."""

    accepted = frozenset({Fault.CURRENT_SENSOR})

    def draw(self):
        self.sign = int(self.rng.choice([-1, 1]))

    def reads(self, inputs):
        inputs.current_ma[self.joint] = self.sign * max(self.sign * inputs.current_ma[self.joint], 0)


class CurrentFrozen(Broken):
    """The current's sensor stays at what it showed."""

    accepted, must = frozenset({Fault.CURRENT_SENSOR}), True

    def draw(self):
        self.seen = None

    def reads(self, inputs):
        self.seen = inputs.current_ma[self.joint] if self.seen is None else self.seen
        inputs.current_ma[self.joint] = self.seen


class BrushLifts(Broken):
    """A brush that loses its contact for 1 to 4 ms every 10 to 40 ms."""

    accepted = frozenset({Fault.MOTOR, Fault.CURRENT_SENSOR})

    def draw(self):
        self.ohm, self.left, self.lifted = float(self.model[0, self.joint]), 0, False

    def drives(self, outputs):
        self.left -= 1
        if self.left < 0:
            self.lifted = not self.lifted
            self.left = int(self.rng.integers(1, 5) if self.lifted else self.rng.integers(10, 41))
        self.model[0, self.joint] = self.ohm * (50.0 if self.lifted else 1.0)


class LeadBroken(Broken):
    """A lead of the motor breaks."""

    accepted, must = frozenset({Fault.CURRENT_SENSOR, Fault.MOTOR}), True

    def drives(self, outputs):
        self.model[0, self.joint] = 1e6


class MagnetsFade(Broken):
    """The motor's constant fades to 0.6 within 4 s."""

    accepted = frozenset({Fault.MOTOR, *LOADS})

    def draw(self):
        self.constant, self.left = float(self.model[1, self.joint]), 1.0

    def drives(self, outputs):
        self.left = max(self.left - 1e-4, 0.6)
        self.model[1, self.joint] = self.constant * self.left


class StreamStops(Broken):
    """The host falls silent at full speed."""

    accepted, must = frozenset({Fault.HOST_SILENT}), True

    def reads(self, inputs):
        inputs.command.kind = c.COMMAND_NONE


class StreamFreezes(Broken):
    """The host sends its last motion command again and again."""

    accepted = frozenset({Fault.HOST_SILENT})

    def draw(self):
        self.last = None

    def reads(self, inputs):
        move = inputs.command.move
        now = (move.position_rad[:], move.speed_rad_s[:])
        self.last = now if self.last is None else self.last
        move.position_rad[:], move.speed_rad_s[:] = self.last


class CommandsLost(Broken):
    """Of 100 commands one to thirty are lost, a bus whose frames come corrupted."""

    def draw(self):
        self.share = self.rng.uniform(0.01, 0.3)

    def reads(self, inputs):
        if self.rng.uniform() < self.share:
            inputs.command.kind = c.COMMAND_NONE


class Sound(Broken):
    """Nothing is broken."""


KINDS = {kind.__name__: kind for kind in [*Broken.__subclasses__(), HalfBridgeDead, WiperFloats, TrackWorn]}


def case(library, seed, kind, moving):
    """Return what came of a case, the codes, speed over the limit, ms until the first code, and whether it ran on."""
    arm = drawn_arm(library, seed)
    joint = int(arm.rng.integers(6))
    arm.enable()
    arm.rest(400)
    until_moving(arm, joint)
    if not moving:
        arm.rest(600)
    if arm.first[0] is not None:
        return "before", arm.first[0].name, 0.0, None, False
    broken = KINDS[kind](arm, joint, np.random.default_rng([seed, 21]))
    broken.on, begun, late, fast, since, ran = True, arm.ticks, None, 0.0, None, False
    limit = float(arm.core.config.joint[joint].speed_limit_rad_s)
    while arm.ticks - begun < LOOK_TICKS and (late is None or arm.ticks - begun < late + 700):
        arm.swing(PERIOD_TICKS, stop_at_fault=False) if moving else arm.rest_on(PERIOD_TICKS)
        out, speed = arm.out[0], abs(float(arm.plant.qd[joint])) / limit
        if out["drives_on"] and arm.core.joint[joint].released == 0:
            fast = max(fast, speed)
            since = (since if since is not None else arm.ticks) if speed > SPEED else None
            ran = ran or (since is not None and arm.ticks - since > ASLEEP_MS)
        late = arm.ticks - begun if late is None and arm.first[0] is not None else late
    if late is not None:
        arm.tick(NAMED_TICKS)
    fault, where = arm.first
    names = {f for f in Fault if f and int(arm.out[0]["joint_faults"][joint]) >> f % 32 & 1}
    names |= {fault} if where is None and fault is not None else set()
    if fault is None:
        result = "silent" if broken.must else "named"
    elif where not in (None, joint):
        result = "wrong"
    else:
        result = "named" if fault in broken.accepted else "beside" if names & broken.accepted else "wrong"
    shown = "+".join(sorted(f.name for f in names)) or ("-" if fault is None else f"{fault.name} of another joint")
    return result, shown, fast, late, ran


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", type=int, nargs="?", default=20)
    parser.add_argument("--seed", type=int, default=5001)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    library, total = opened(), Counter()
    for number, kind in enumerate(KINDS):
        if given.only.lower() not in kind.lower():
            continue
        for moving in (True, False):
            results, codes, fasts, lates, ran = Counter(), Counter(), [], [], 0
            wrong = defaultdict(list)
            for index in range(given.cases):
                seed = given.seed * 1000003 + 97 * index + number
                result, shown, fast, late, on = case(library, seed, kind, moving)
                results[result] += 1
                codes[shown] += 1
                fasts.append(fast)
                lates += [late] if late is not None else []
                ran += on
                if result not in ("named", "beside") or on:
                    wrong[shown].append(seed)
            total += results
            line = f"{kind + (' moving' if moving else ''):28}" + ", ".join(
                f"{k} {n}" for k, n in results.most_common()
            )
            print(
                f"{line}; fast {max(fasts):.2f}, ran {ran}, ms {np.median(lates) if lates else float('nan'):.0f}; ",
                end="",
            )
            print(", ".join(f"{k} {n}" for k, n in codes.most_common()), end="")
            print("".join(f"; {k}: {s[:3]}" for k, s in wrong.items()), flush=True)
    print(dict(total))


if __name__ == "__main__":
    main()
