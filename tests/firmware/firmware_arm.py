"""A simple arm on the firmware's core: six motors that drive joints with potentiometers, and a host that can command."""

import ctypes
import math
from collections.abc import Callable

from firmware_layout import c

COUNTS_PER_RAD = (62258 - 3277) / 5.2
JOINTS = range(c.JOINTS)
Library = ctypes.CDLL


def declare(library: Library) -> Library:
    """Declare to ctypes what the core's functions take and give."""
    flag, real, word, pointer = ctypes.c_bool, ctypes.c_float, ctypes.c_uint32, ctypes.c_void_p
    signatures = {
        "host_size": (word, [ctypes.c_char_p]),
        "core_init": (None, [pointer, pointer, word, word]),
        "core_tick": (None, [pointer, pointer, pointer]),
        "pid_reset": (None, [pointer, real]),
        "pid_measure": (None, [pointer, pointer, real]),
        "pid_step": (real, [pointer, pointer, pointer, pointer]),
        "pid_change_gains": (None, [pointer, pointer, pointer]),
        "setpoint_hold": (None, [pointer, real]),
        "setpoint_aim": (flag, [pointer, real, real, word, real]),
        "setpoint_advance": (None, [pointer]),
        "setpoint_slow": (flag, [pointer, real]),
        "setpoint_clamp": (flag, [pointer, real, real]),
        "pot_angle": (real, [pointer, word]),
        "pot_read": (word, [pointer, pointer, word, word]),
        "encoder_frames_sound": (flag, [word]),
        "encoder_magnet_wrong": (flag, [word]),
        "encoder_read": (word, [pointer, pointer, pointer, word, word]),
        "encoder_telemetry": (word, [pointer, word]),
        "sync_led_on": (flag, [pointer, word]),
        "config_crc": (word, [pointer, word]),
        "config_factory": (None, [pointer]),
        "config_is_valid": (flag, [pointer]),
        "config_upgrade": (None, [pointer]),
        "config_seal": (None, [pointer, pointer, word]),
        "config_load": (word, [pointer, pointer, pointer]),
        "config_next": (word, [pointer, pointer, ctypes.POINTER(word)]),
    }
    for which in ("fault", "state", "rejection"):
        for what in ("name", "text"):
            signatures[f"{which}_{what}"] = (ctypes.c_char_p, [word])
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def lab_config(library: Library):
    """A configuration of an arm that works: the factory's table of angles, firm gains, limits to run into."""
    config = c.core_config()
    library.config_factory(ctypes.byref(config))
    for joint in config.joint:
        joint.gains = c.joint_gains(4.0, 8.0, 0.1, 0.2, 0.0, 0.0, 0.005, 20.0)
        joint.speed_limit_rad_s, joint.deceleration_rad_s2 = 2.0, 10.0
        joint.acceleration_rad_s2, joint.jerk_rad_s3 = 1000.0, 1e6
        joint.duty_limit, joint.duty_slew_per_s, joint.stall_duty = 0.8, 50.0, 0.5
    config.stall_ticks, config.following_ticks = 200, 20
    return config


class LabArm:
    """The core, a plant (speed follows duty: 5 rad/s at full duty, 30 ms) and what the board and the host put in."""

    def __init__(self, library: Library, config=None, *, source=c.CONFIG_NEWEST, watchdog=False, angle_rad=0.0):
        self.library = library
        self.config = config or lab_config(library)
        self.core, self.inputs, self.outputs = c.core_state(), c.core_inputs(), c.core_outputs()
        library.core_init(
            ctypes.byref(self.core), ctypes.byref(self.config), source, c.RESET_WATCHDOG if watchdog else c.RESET_POWER
        )
        self.angle_rad = [angle_rad] * c.JOINTS
        self.speed_rad_s = [0.0] * c.JOINTS
        self.inputs.supply_mv = 12000
        self.sequence = 0
        self.blocked = False
        self.spoil: Callable[[LabArm], None] = lambda arm: None
        self.history: list[bytes] = []

    def _move(self) -> None:
        for i in JOINTS:
            drive = self.outputs.duty[i] * 5.0 if self.outputs.drives_on else 0.0
            self.speed_rad_s[i] += 0.001 / 0.03 * (drive - self.speed_rad_s[i])
            if self.blocked:
                self.speed_rad_s[i] = 0.0
            self.angle_rad[i] += 0.001 * self.speed_rad_s[i]

    def counts(self, i: int) -> int:
        """What the converter reads of joint ``i``: it never stands quite still."""
        noise = (self.inputs.tick * 7 + i) % 3 - 1
        return min(65535, max(0, 3277 + noise + round((self.angle_rad[i] + 2.6) * COUNTS_PER_RAD)))

    def tick(self, ticks: int = 1):
        """Run ticks of 1 ms; ``spoil(arm)`` may change the inputs of each before it runs."""
        for _ in range(ticks):
            self._move()
            self.inputs.tick = (self.inputs.tick + 1) % 2**32
            for i in JOINTS:
                self.inputs.counts[i] = self.counts(i)
            self.spoil(self)
            self.library.core_tick(*map(ctypes.byref, (self.core, self.inputs, self.outputs)))
            self.inputs.command.kind = c.COMMAND_NONE
            self.history.append(bytes(self.outputs))
        return self.outputs

    def command(self, kind: int):
        """Give a command and run the tick that takes it."""
        self.sequence += 1
        self.inputs.command.kind, self.inputs.command.sequence = kind, self.sequence
        return self.tick()

    def move(self, position_rad, *, speed_rad_s=0.0, ticks=10, gravity=0.0):
        """Give all joints one motion command and run the tick that takes it."""
        move = self.inputs.command.move
        for i in JOINTS:
            move.position_rad[i], move.speed_rad_s[i], move.gravity_duty[i] = position_rad, speed_rad_s, gravity
        move.duration_ticks = ticks
        return self.command(c.COMMAND_MOVE)

    def enable(self):
        """Let the readings settle, then enable."""
        self.tick(20)
        return self.command(c.COMMAND_ENABLE)

    def wander(self, ticks: int, *, period=10, amplitude_rad=0.4):
        """Follow a slow sine for so many ticks, as a host of 1000/``period`` Hz would command it."""
        for k in range(ticks // period):
            at_s = (k + 1) * period * 0.001
            angle, rate = 2 * math.pi * 0.5 * at_s, 2 * math.pi * 0.5
            self.move(amplitude_rad * math.sin(angle), speed_rad_s=amplitude_rad * rate * math.cos(angle), ticks=period)
            self.tick(period - 1)
        return self.outputs

    def acknowledged(self) -> bool:
        """Return whether the last command was acknowledged; it was rejected otherwise."""
        acknowledged = self.outputs.acknowledged_sequence == self.sequence
        assert acknowledged != (self.outputs.rejected_sequence == self.sequence)
        return acknowledged


def twin_of(arm):
    """A second arm in the very same condition."""
    twin = LabArm(arm.library)
    for name in ("core", "inputs", "outputs"):
        record = getattr(arm, name)
        setattr(twin, name, type(record).from_buffer_copy(record))
    twin.angle_rad, twin.speed_rad_s = [*arm.angle_rad], [*arm.speed_rad_s]
    return twin


def read_as(joint, counts):
    """A spoiler: this potentiometer reads so many counts."""

    def spoil(arm):
        arm.inputs.counts[joint] = counts

    return spoil


def supply(millivolts):
    """A spoiler: the supply has so many millivolts."""

    def spoil(arm):
        arm.inputs.supply_mv = millivolts

    return spoil
