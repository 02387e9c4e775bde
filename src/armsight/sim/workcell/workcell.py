"""The workcell: an arm with motors, a board that runs the firmware, two cameras, a body on the tool, and time.

Time is the plant's, in milliseconds. It passes when a board is listened to, when a shot is waited for, and by
:meth:`Workcell.advance`; each millisecond the firmware runs once and the arm moves on. The workcell gives out a Board and a
Source, which behave as real ones do. The truth is in :attr:`Workcell.truth`, for evaluation only. Presets and amounts: the
documentation's page on the workcell.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple, Self

import numpy as np

from armsight.data import Array, Image, Record, Shot
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.robot.arm_file import open_arm
from armsight.robot.board_registry import configured, slowed
from armsight.robot.boards.codes import Reaction
from armsight.robot.boards.configuration import (
    CONFIG,
    JOINTS,
    SYNC_LED_TICKS,
    Configuration,
    check_configuration,
    pin_number,
)
from armsight.robot.boards.contract import Closing, MotionBoard
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import open_emulator
from armsight.robot.boards.link import TICK_S
from armsight.robot.kinematics.arm import Arm
from armsight.sim.camera.stages import CameraPipeline
from armsight.sim.example_rig import board_poses
from armsight.sim.references.distance import DrawWire
from armsight.sim.references.heading import MagneticUnit
from armsight.sim.references.inertial import InertialUnit
from armsight.sim.render.optics import Sensor
from armsight.sim.render.scene import charuco, chessboard
from armsight.sim.workcell.arm import Imperfections, imperfections, pot_travel, sample_arm
from armsight.sim.workcell.body import body_target, body_text, patterns_of
from armsight.sim.workcell.cameras import (
    BASELINE_M,
    DISTANCE_M,
    LED_AT,
    CameraTiming,
    WorkcellSource,
    open_cameras,
    open_rig,
    rig_pose,
)
from armsight.sim.workcell.controlled import CONTROLLED, Controlled, ControlledArm, standing
from armsight.sim.workcell.images import LENS, WorkcellCamera, picture
from armsight.sim.workcell.motors import (
    ACCELERATION_SPARE,
    SUPPLY_V,
    Motors,
    Solids,
    chosen,
    gravity_torque,
    inertia,
    solids,
)
from armsight.sim.workcell.plant import COUNTS, HIGH_SHARE, LOW_SHARE, ArmPlant
from armsight.vision.markers.board import open_board
from armsight.vision.markers.charuco import Charuco
from armsight.vision.markers.chessboard import Chessboard
from armsight.vision.markers.targets import Composite
from armsight.vision.rig import StereoRig

#: Natural frequency, rad/s, of each joint's loop; its damping; integral gain per proportional gain, 1/s; filter of the
#: speed, s. As stiff as the potentiometers' noise allows: where dry friction holds a joint that is off by little, only the
#: integral frees it, and a loop that is closed on vision meanwhile winds up and hunts.
NATURAL_RAD_S = np.array([50.0, 70.0, 80.0, 85.0, 90.0, 90.0])
DAMPING, INTEGRAL_PER_S, FILTER_S = 1.0, 8.0, 0.004
_JERK_S = 0.01  # from no acceleration to all of it; half: rougher, double: slower
_BRAKE_TICKS = 20
SYNC_LED_PIN = "PB13"
_SPEED_SPARE = 1.2  # of the reference's limit over the arm's own


def configuration(model: Arm, parts: Solids, motors: Motors, *, sync_led: bool = False) -> Configuration:
    """Return the board's configuration for a nominal arm and its motors; ``sync_led``: an LED blinks its clock.

    With ``J`` the inertia at the joint, ``B`` the damping of motor and friction and ``K`` the stall torque, the loop
    ``J q'' + (B + K kd) q' + K kp q = K kp r`` is given the natural frequency and the damping that are asked for; the
    feed-forward ``kv = B / K`` compensates the motor's own voltage. The host compensates gravity (:func:`gravity_duty`).
    """
    config = np.zeros((), CONFIG)
    joint, travel = config["joint"], pot_travel(model)
    inertia_kg_m2 = motors.rotor_inertia + inertia(model, parts, model.home)
    damping = motors.emf_damping + motors.viscous
    gains = joint["gains"]
    gains["kp_per_rad"] = inertia_kg_m2 * NATURAL_RAD_S**2 / motors.stall_nm
    gains["ki_per_rad_s"] = INTEGRAL_PER_S * gains["kp_per_rad"]
    gains["kd_s_per_rad"] = np.maximum(2 * DAMPING * NATURAL_RAD_S * inertia_kg_m2 - damping, 0.0) / motors.stall_nm
    gains["kv_s_per_rad"] = damping / motors.stall_nm + gains["kd_s_per_rad"]
    gains["ka_s2_per_rad"] = inertia_kg_m2 / motors.stall_nm
    gains["derivative_filter_s"], gains["anti_windup_per_s"] = FILTER_S, 20.0
    pot = joint["pot"]
    pot["node_count"], pot["direction"] = 2, 1
    pot["counts"][:, :2] = np.rint(np.array([LOW_SHARE, HIGH_SHARE]) * COUNTS)
    pot["angle_rad"][:, :2] = travel
    pot["short_counts"], pot["open_counts"] = round(0.02 * COUNTS), round(0.98 * COUNTS)
    pot["jump_rad"] = 0.01 + 2e-3 * model.qd_max
    pot["frozen_rad"], pot["inverted_rad"] = 0.05, 0.1
    joint["soft_min_rad"], joint["soft_max_rad"] = model.q_min, model.q_max
    joint["speed_limit_rad_s"] = _SPEED_SPARE * model.qd_max
    joint["deceleration_rad_s2"] = model.qdd_max
    joint["acceleration_rad_s2"] = ACCELERATION_SPARE * model.qdd_max
    joint["jerk_rad_s3"] = joint["acceleration_rad_s2"] / _JERK_S
    joint["gravity_slew_per_s"] = 5.0
    motor = joint["motor"]
    motor["resistance_ohm"] = motors.resistance_ohm
    motor["constant_v_s"] = motors.gear_ratio * motors.torque_constant
    motor["apart_rad"], motor["backlash_rad"] = 0.03, 0.001
    # A narrower slew limit would cut the noise unevenly in motion, which brakes.
    joint["duty_limit"], joint["duty_slew_per_s"], joint["current_cut_per_a_s"] = 1.0, 1000.0, 20.0
    joint["current_limit_ma"] = np.rint(900.0 * motors.current_max_a)
    joint["following_rad"], joint["stall_duty"], joint["stall_rad"] = 0.15, 0.9, 0.005
    joint["motor_direction"] = 1
    config["joint_count"] = len(joint)
    config["supply_min_mv"], config["supply_max_mv"], config["supply_ticks"] = 20000, 28000, 5
    config["supply_nominal_mv"], config["overload_ticks"] = round(1e3 * SUPPLY_V), 300
    config["brake_release_ticks"] = config["brake_engage_ticks"] = _BRAKE_TICKS
    config["pot_ticks"], config["following_ticks"], config["stall_ticks"] = 5, 50, 300
    config["silence_ticks"], config["silence_reaction"] = 100, Reaction.HOLD
    config["sync_led_ticks"] = SYNC_LED_TICKS
    config["sync_led_pin"] = pin_number(SYNC_LED_PIN) if sync_led else 0
    check_configuration(config)
    return config


def gravity_duty(model: Arm, parts: Solids, motors: Motors, q: Array) -> Array:
    """Return the duty (6,) that compensates the gravity load of the nominal arm at joint angles q (6,), rad."""
    return np.asarray(np.clip(-gravity_torque(model, parts, q) / motors.stall_nm, -1.0, 1.0))


#: The arm that the workcell was drawn for.
DEFAULT_ARM = "six_r"
#: Where the cameras stand before a small arm, m.
NEAR_M = 0.6
#: The chessboard that is shown to the cameras.
CHESSBOARD = "chessboard:9x6:30mm"
_CHESSBOARD_FILL = (0.35, 1.0)  # of the image's height
#: Where an inertial unit is on the tool.
_T_TOOL_UNIT = exp_se3(np.array([0.02, -0.015, -0.03, 0.3, -0.2, 1.0]))
#: The body on the tool: rotated by 180 degrees about y, so that its z runs into the plate, on a bracket to the cameras.
_MOUNT_M, _MOUNT_RAD = np.array([0.003, -0.004, 0.035]), np.radians([-10.0, 12.0, 4.0])
#: Five poses, seen from home: the tool's shift, m, base axes, and its rotation vector about its own axes, degrees.
_POSES = (
    ((-0.17, 0.20, 0.08), (-8.0, 12.0, 12.0)),
    ((-0.17, -0.20, 0.11), (-12.0, -12.0, -20.0)),
    ((-0.16, -0.17, -0.13), (12.0, -12.0, 25.0)),
    ((-0.18, 0.17, -0.12), (14.0, 12.0, -28.0)),
    ((-0.24, 0.02, 0.15), (-14.0, 4.0, 20.0)),
)
_POSES_SHARES = (1.0, 0.75, 0.5, 0.35)  # of the shifts that are tried with another arm, until it reaches all five
_POSES_SIZE_M = (
    1.06  # of the arm that these shifts were chosen for; ahead, left and up of the tool are x, y and z there
)


@dataclass(frozen=True, eq=False)
class WorkcellTruth(Record):
    """The true values of a workcell up to now. No estimator gets them."""

    arm: Arm  #: the true table
    rig: StereoRig  #: the true cameras; covariance zero
    T_base_rig: Array  #: (4, 4) where the left camera is, m
    T_tool_body: Array  #: (4, 4) where the body is on the tool, m
    t_s: Array  #: (N,) every millisecond since the beginning, s
    q: Array  #: (N, n) true joint angles, rad: of the links, behind backlash and twist
    shaft: Array  #: (N, n) true angles of the gears' shafts, where the potentiometers sit, rad
    shot_t_s: dict[str, float]  #: name of each shot handed out -> middle of its left exposure, s

    @cached_property
    def T_base_tool(self) -> Array:
        """(N, 4, 4) where the tool really was, m."""
        return self.arm.forward(self.q)


class _Parts(NamedTuple):
    """What a workcell is made of; ``model`` is the table that it is assumed to have, ``default`` the arm it was drawn for.

    ``room``: what must be the same for another workcell to use these cameras; ``pipeline``: None for white noise;
    ``link``: None where the arm keeps its own controller; ``gravity`` returns the duty (n,) that compensates the
    nominal arm's load at angles (n,), rad; p_led (3,), m, base frame, None without the sync LED.
    """

    model: Arm
    timing: CameraTiming
    seed: int
    plant: ArmPlant | ControlledArm
    rig: StereoRig
    T_base_rig: Array
    T_tool_body: Array
    cameras: tuple[WorkcellCamera, WorkcellCamera]
    room: tuple[object, ...]
    pipeline: CameraPipeline | None
    link: EmulatedLink | None
    board: MotionBoard
    gravity: Callable[[Array], Array]
    default: bool
    p_led: Array | None
    processes: bool
    target: Composite | None


def _standing(
    rig: StereoRig, T_base_rig: Array, plant: ArmPlant | ControlledArm, seed: int, sensor: Sensor, psf_sigma_px: float
) -> tuple[WorkcellCamera, WorkcellCamera]:
    stand = partial(WorkcellCamera, foot=plant.parts, seed=seed, sensor=sensor, psf_sigma_px=psf_sigma_px)
    return stand(rig.left, T_base_rig), stand(rig.right, T_base_rig @ rig.T_left_right)


def _ahead(T_base_tool: Array) -> Array:
    """Return axes (3, 3) of the base, as columns: level ahead as the tool looks, to its left, up."""
    level = T_base_tool[:3, 2] * np.array([1.0, 1.0, 0.0])
    level /= np.linalg.norm(level)
    up = np.array([0.0, 0.0, 1.0])
    return np.column_stack([level, np.cross(up, level), up])


def workcell_poses(model: Arm, *, default: bool) -> Array:
    """Return the joint angles (5, n) of five poses before the cameras, rad; at home the tool looks at them.

    ``default``: the arm that the workcell was drawn for; another's shifts follow its size and its reach. InputError:
    the arm does not reach one.
    """
    T_home = model.forward(model.home)
    if default:
        return _five(model, T_home, np.eye(3))
    axes = model.size_m / _POSES_SIZE_M * _ahead(T_home)
    for share in _POSES_SHARES[:-1]:
        with contextlib.suppress(InputError):
            return _five(model, T_home, share * axes)
    return _five(model, T_home, _POSES_SHARES[-1] * axes)


def _five(model: Arm, T_home: Array, axes: Array) -> Array:
    """Return the joint angles (5, n) of the five poses, their shifts along axes (3, 3), as columns."""
    found = []
    for n, (shift, rotation) in enumerate(_POSES, start=1):
        T = pose(T_home[:3, :3] @ exp_so3(np.radians(rotation)), T_home[:3, 3] + axes @ np.array(shift))
        solutions = model.inverse(T, near=model.home)
        if solutions.best is None:
            raise InputError(f"{model.name} does not reach pose {n} of the workcell: {solutions.reason}")
        found.append(solutions.best)
    return np.array(found)


def _driven(
    model: Arm, amounts: Imperfections, seed: int, emulator: str, own: Controlled | None, *, sync_led: bool
) -> tuple[ArmPlant | ControlledArm, EmulatedLink | None, MotionBoard, Callable[[Array], Array]]:
    """Return an arm that was built to a model, the wire to our board if it has one, the board, and the gravity's duty."""
    if own is not None and sync_led:
        raise InputError(f"{model.name} keeps its own controller, which drives no sync LED")
    if own is not None:  # its zeros are off in its controller
        arm, own_board = own.open(sample_arm(model, replace(amounts, zero_rad=0.0), seed).arm, amounts, seed)
        return arm, None, own_board, np.zeros_like
    if model.joints != JOINTS:
        raise InputError(
            f"{model.name} has {model.joints} joints; the workcell takes arms of {JOINTS} with our firmware, and "
            f"{', '.join(CONTROLLED)} with their own controllers"
        )
    links = solids(model)
    motors = chosen(model, links)  # as the drawing has them: friction as usual
    plant = ArmPlant(model, sample_arm(model, amounts, seed), seed)
    link = EmulatedLink(open_emulator(emulator), plant)
    board = configured(link, configuration(model, links, motors, sync_led=sync_led))
    return plant, link, board, partial(gravity_duty, model, links, motors)


class Workcell(Closing):
    """An arm, its board, two cameras and a body; :meth:`open` builds one.

    ``model`` is the arm as it is assumed to be: all that an estimator may know of it. ``link`` is the wire to our board,
    and all of its inside, None where the arm keeps its own controller. ``board`` is configured, its drives off; the arm is
    at home, held by brakes or its controller. ``timing`` is what the cameras' maker says: rate, exposure, synchronisation.
    """

    def __init__(self, parts: _Parts) -> None:
        """Put the parts together; :meth:`open` makes them."""
        self.model, self.timing, self._seed = parts.model, parts.timing, parts.seed
        self.plant, self.gravity_duty, self._default = parts.plant, parts.gravity, parts.default
        self._rig, self._room, self._cameras = parts.rig, parts.room, parts.cameras
        self._T_tool_body, self._T_base_rig = parts.T_tool_body, parts.T_base_rig
        self.link, self.board = parts.link, parts.board
        self.target = parts.target or body_target()
        self.body_text = body_text()
        clock = (lambda: self.t_s, self.advance)
        body = (patterns_of(self.target), self._T_tool_body)
        led = None if parts.p_led is None or self.link is None else (parts.p_led, self.link.sync_led)
        sees = (self.plant, self._cameras, self.timing, body, clock, self._seed, parts.pipeline)
        self.source = WorkcellSource(*sees, led, processes=parts.processes)

    @classmethod
    def open(
        cls,
        *,
        arm: str = "used",
        cameras: str = "1280x720@60",
        seed: int = 0,
        emulator: str = "unicorn",
        rig: str = "parallel",
        model: Arm | None = None,
        assumed: Arm | None = None,
        distance_m: float | None = None,
        baseline_m: float = BASELINE_M,
        noise: float = 2.0,
        like: Workcell | None = None,
        sync_led: bool = False,
        processes: bool = False,
        target: Composite | None = None,
    ) -> Self:
        """Build a workcell; a second or so. The same ``seed`` gives the same numbers.

        ``arm``: how far it is from its table: nominal, used, worn, or a TOML file; ``model``: the table that it was built
        to, ``assumed``: the one that it is assumed to have. ``cameras``: 1280x720@60, webcams, a preset or TOML file of a
        camera, and their like; ``rig``: parallel or verging; ``distance_m``: to the body of the arm at home; ``noise``:
        grey levels. ``like``: a workcell of the same arm, seed, rig and noise, whose view of the room is used again.
        ``sync_led``: an LED on the board's clock is in view. ``processes``: each camera is rendered in a process of its
        own, for long runs. ``target``: the body on the tool.
        """
        if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**32:
            raise InputError(f"seed {seed!r}: must be a whole number from 0 to {2**32 - 1}")
        if not 0 <= noise <= 50:
            raise InputError(f"noise is {noise}; it must be 0 to 50 grey levels")
        (timing, pipeline), amounts = open_cameras(cameras), imperfections(arm)
        built_to = model if model is not None else open_arm(DEFAULT_ARM)
        true_rig = open_rig(rig, timing.image_size_px, baseline_m)
        own, nominal_home = CONTROLLED.get(built_to.name), built_to.home
        built_to = standing(built_to)
        if assumed is not None and built_to.home is not nominal_home:
            assumed = replace(assumed, home=built_to.home)
        if own is not None:
            built_to = slowed(built_to, own.board)
            assumed = None if assumed is None else slowed(assumed, own.board)
        if distance_m is None:
            distance_m = DISTANCE_M if own is None else NEAR_M
        psf_sigma_px = LENS.psf_sigma_px if pipeline is None else pipeline.psf_sigma_px
        room = (
            arm,
            rig,
            seed,
            baseline_m,
            distance_m,
            noise,
            psf_sigma_px,
            timing.image_size_px,
            built_to.table.tobytes(),
        )
        if like is not None and like._room != room:
            both = f"this workcell is {room[:-1]}, the one it is to be like is {like._room[:-1]}"
            raise InputError(f"{both}: arm, rig, seed, distances, noise, blur, image size and table must be the same")
        mount = pose(np.diag([-1.0, 1.0, -1.0]), _MOUNT_M) @ pose(exp_so3(_MOUNT_RAD), np.zeros(3))
        off = np.random.default_rng([seed, 9]).normal(0, 1, 6) * np.repeat((0.002, np.radians(1.0)), 3)
        T_base_rig = rig_pose(built_to, true_rig, mount, seed, distance_m)
        plant, link, board, gravity = _driven(built_to, amounts, seed, emulator, own, sync_led=sync_led)
        sensor = Sensor(read_noise=noise)
        seen = like._cameras if like is not None else _standing(true_rig, T_base_rig, plant, seed, sensor, psf_sigma_px)
        known = assumed if assumed is not None else built_to
        parts = (known, timing, seed, plant, true_rig, T_base_rig, mount @ exp_se3(off), seen, room)
        p_led = transform(T_base_rig, distance_m * np.array(LED_AT)) if sync_led else None
        return cls(
            _Parts(*parts, pipeline, link, board, gravity, built_to.name == DEFAULT_ARM, p_led, processes, target)
        )

    @property
    def t_s(self) -> float:
        """The time now, s, on the board's clock too."""
        return self.plant.t_s if self.link is None else self.link.t_s

    def advance(self, dt_s: float) -> None:
        """Let time pass, to the nearest millisecond."""
        if isinstance(self.plant, ControlledArm):
            self.plant.advance(dt_s)
        elif self.link is not None:
            self.link.step(round(dt_s / TICK_S))

    def poll(self) -> Shot | None:
        """Return the newest shot that has come by now and was not handed out; no time passes."""
        return self.source.poll()

    @cached_property
    def poses(self) -> Array:
        """(5, n) the joint angles of the workcell's five poses, rad, as the nominal table has them; body in view."""
        return workcell_poses(self.model, default=self._default)

    def carry(self, unit: InertialUnit | MagneticUnit | DrawWire) -> Callable[[float], tuple[Array, Array]]:
        """Return what reads a sensor on the tool: stamps (N,) up to a time, s, and readings (N, m), each once."""
        at = self.plant.travelled.ticks

        def read(end_s: float) -> tuple[Array, Array]:
            nonlocal at
            begin, at = at, max(min(round(end_s / TICK_S), self.plant.travelled.ticks), at)
            first = self.plant.travelled.begin
            q = self.plant.path[begin + 1 - first : at + 1 - first, self.plant.arm.joints :]
            t_s = np.asarray(TICK_S * np.arange(begin + 1, at + 1), np.float64)
            return unit.read(t_s, self.plant.arm.forward(q) @ _T_TOOL_UNIT)

        return read

    def board_shots(self, count: int, spec: str = CHESSBOARD) -> Iterator[Shot]:
        """Show a board in ``count`` poses, as a person would who calibrates, past the arm; no time passes.

        InputError, before the first shot: the board is neither a chessboard nor a charuco board that begins at 0.
        """
        board = open_board(spec)
        if not isinstance(board, Chessboard | Charuco) or (isinstance(board, Charuco) and board.first):
            raise InputError(f"{spec}: simulated cameras show a chessboard or a charuco board")
        size = (board.columns, board.rows, board.square_m)
        pattern = charuco(*size, board.marker_m, board.family) if isinstance(board, Charuco) else chessboard(*size)
        rng = np.random.default_rng([self._seed, 10])
        poses = (
            T
            for _ in itertools.count()
            for T in board_poses(rng, self._rig, pattern, count, fill=_CHESSBOARD_FILL)
            if self.source.clear(pattern, T)
        )
        return (self.source.still((pattern,), T, k) for k, T in enumerate(itertools.islice(poses, count)))

    def cover(self, from_s: float, to_s: float) -> None:
        """Hold a card before the body from one time to another: it is not seen meanwhile."""
        self.source.cover(from_s, to_s)

    def picture(self, size_px: tuple[int, int] = (1280, 720)) -> Image:
        """Return the workcell as it is now, seen from the side, (H, W, 3) BGR."""
        body = (patterns_of(self.target), self._T_tool_body)
        return picture(size_px, self.plant, body, (self._T_base_rig, self._rig), self._seed)

    @property
    def truth(self) -> WorkcellTruth:
        """The true values up to now; for evaluation only."""
        ticks, path = self.plant.travelled.whole()
        taken = {name: times.left_s for name, times in self.source.taken.items()}
        return WorkcellTruth(
            self.plant.arm,
            self._rig,
            self._T_base_rig,
            self._T_tool_body,
            np.asarray(ticks * TICK_S, dtype=np.float64),
            path[:, self.plant.arm.joints :],
            path[:, : self.plant.arm.joints],
            taken,
        )

    def forget_room(self) -> None:
        """Drop what the cameras see of the room, 80 MB each at 1280 x 720; the next image takes a second longer."""
        for camera in self._cameras:
            camera.forget()

    def close(self) -> None:
        """End the firmware and the threads; harmless when called twice."""
        self.board.close()
        self.source.close()
