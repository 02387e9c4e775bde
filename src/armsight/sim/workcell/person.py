"""The workcell as live cameras, and a person in it: who covers a lens, pulls a cable, and holds the calibration board.

In: ``sim:`` with the cameras of :mod:`armsight.sim.workcell`. Out: a source at the cameras' pace. The person sees what a
page shows, the outline of the board in both views, and moves the board there with an unsteady hand; nothing else is passed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from armsight.data import Array, Shot
from armsight.errors import DeviceError, InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3, transform
from armsight.processes import return_freed
from armsight.robot.kinematics.arm import Arm
from armsight.sim.example_rig import board_poses
from armsight.sim.render.scene import chessboard
from armsight.sim.workcell.workcell import CHESSBOARD, Workcell
from armsight.vision.markers.board import open_board
from armsight.vision.pose.pnp import body_poses
from armsight.vision.sources import Source

ACTIONS = ("cover_left", "cover_right", "uncover", "unplug", "plug", "board", "no_board")
#: A hand comes so near to an outline, m and rad; moves so fast, s per pose; and trembles, m and rad.
_HAND, _MOVE_S, _TREMOR = (0.012, np.radians(3.0)), 1.2, (1e-4, np.radians(0.02))
#: Of the image's height; poses among which one beside the arm is looked for, and how often.
_FILL, _TRIES, _ROUNDS = (0.4, 0.8), 30, 5
_PACE_HZ = 15.0


class Person:
    """A person with a board before the workcell's cameras; ``seed`` is of the hand."""

    def __init__(self, workcell: Workcell, seed: int) -> None:
        self._workcell, self._rng = workcell, np.random.default_rng([seed, 21])
        self._pattern = chessboard(9, 6, 0.030)
        self._points = open_board(CHESSBOARD).body.points
        #: From where, to where, T_left_board (4, 4), and since when the board moves; None before it is held.
        self._way: tuple[Array, Array, float] | None = None
        self._shown: Array | None = None  # the outline that is being reached
        self.covered: set[str] = set()
        self.unplugged = self.holds = False

    def act(self, action: str) -> None:
        """Do something."""
        if action not in ACTIONS:
            raise InputError(f"the simulated person does not know {action!r}; known are {', '.join(ACTIONS)}")
        if action.startswith("cover_"):
            self.covered.add(action.removeprefix("cover_"))
        elif action == "uncover":
            self.covered.clear()
        elif action in ("unplug", "plug"):
            self.unplugged = action == "unplug"
        else:
            self.holds, self._way, self._shown = action == "board", None, None

    def reach(self, outline_uv: tuple[Array, Array] | None) -> None:
        """Move the board to where its points (M, 2) are drawn in both views; beside the arm where nothing is drawn."""
        rig = self._workcell.truth.rig
        if outline_uv is None:
            if self._way is None:
                self._move(self._beside())
            return
        if self._shown is not None and np.abs(self._shown - outline_uv[0]).max() < 1.0:
            return
        self._shown = np.array(outline_uv[0])
        found = body_poses(self._points, rig.left, outline_uv[0])
        if not found:
            return
        T = found[0][0]
        for share in (1.0, 0.5, 0.0):
            near = T @ exp_se3(share * self._rng.normal(0, 1, 6) * np.repeat(_HAND, 3))
            if self._visible(near):
                self._move(near)
                return
        middle = np.array([*rig.T_left_right[:2, 3] / 2, 1.3 * T[2, 3]])
        for step in np.linspace(0.02, 0.9, 30):  # the outline is of other cameras than these: as near as can be seen
            near = np.array(T)
            near[:3, 3] += step * (middle - T[:3, 3])
            if self._visible(near):
                break
        self._move(near)

    def _beside(self) -> Array:
        """Return a pose of the board in view, T_left_board (4, 4), where neither it nor the arm's body hides the other."""
        source, rig = self._workcell.source, self._workcell.truth.rig
        for _ in range(_ROUNDS):
            poses = board_poses(self._rng, rig, self._pattern, _TRIES, fill=_FILL, tilt_deg=15.0)
            for T in poses:
                if source.clear(self._pattern, T, body_seen=True):
                    return np.asarray(T)
        return np.asarray(poses[0])

    def _visible(self, T_left_board: Array) -> bool:
        """Return whether both cameras see all of the board's points, and a little around them."""
        rig, around = self._workcell.truth.rig, 1.1 * self._points - 0.1 * self._points.mean(axis=0)
        sizes = (np.array(camera.image_size_px) for camera in rig.cameras)
        views = zip(rig.project(transform(T_left_board, around)), sizes, strict=True)
        return all(bool(((uv > 4) & (uv < size - 5)).all()) for uv, size in views)

    def _move(self, T: Array) -> None:
        way = self._way
        self._way = T if way is None else _where(way), T, time.monotonic()

    def shot(self, number: int) -> Shot | None:
        """Return what the cameras see while the board is held; None while it is not."""
        way = self._way
        if not self.holds or way is None:
            return None
        T = _where(way) @ exp_se3(self._rng.normal(0, 1, 6) * np.repeat(_TREMOR, 3))
        return replace(self._workcell.source.still((self._pattern,), T, number), name=f"board{number:06d}")


def _where(way: tuple[Array, Array, float]) -> Array:
    """Return where a board is on its way now, T_left_board (4, 4)."""
    start, end, began_s = way
    x = min((time.monotonic() - began_s) / _MOVE_S, 1.0)
    smooth = x * x * (3.0 - 2.0 * x)
    return np.asarray(start @ exp_se3(smooth * log_se3(inverse(start) @ end)))


class SimulatedCameras(Source):
    """The workcell's cameras as a source, at their pace; what it is made of as :meth:`Workcell.open` takes it."""

    count: int | None = None

    def __init__(self, cameras: str, arm: str, seed: int, emulator: str, model: Arm | None = None) -> None:
        self.workcell = Workcell.open(arm=arm, cameras=cameras, seed=seed, emulator=emulator, model=model)
        self.person = Person(self.workcell, seed)
        self.outline: Callable[[], tuple[Array, Array] | None] = lambda: None
        self._number, self._due_s, self._shown = 0, 0.0, False

    def read(self) -> Shot | None:
        """Return the next shot, at the cameras' pace at most."""
        while (shot := self.poll()) is None:
            time.sleep(max(0.0, self._due_s - time.monotonic()))
            if not self.person.holds:
                self._due_s = max(time.monotonic(), self._due_s + self.period_s)
                waited = self.workcell.source.read()
                self.workcell.board.receive()  # what the board said meanwhile must not pile up
                return None if waited is None else self.seen(waited)
        return shot

    def poll(self) -> Shot | None:
        """Return the next shot if it is due and there, a DeviceError once a cable is pulled; no time passes meanwhile."""
        self._require_plugged()
        if time.monotonic() < self._due_s:
            return None
        if not self.person.holds:
            shot = self.poll_now()
        else:
            self.person.reach(self.outline())
            self._number += 1
            held = self.person.shot(self._number)
            shot = None if held is None else self.seen(held)
        if shot is not None:
            self._due_s = max(time.monotonic(), self._due_s + self.period_s)
        return shot

    def poll_now(self) -> Shot | None:
        """Return the newest shot of the workcell, however fast its time passes, for its control loop."""
        self._require_plugged()
        shot = self.workcell.poll()
        return None if shot is None else self.seen(shot)

    def _require_plugged(self) -> None:
        if self.person.unplugged:
            raise DeviceError("left camera: the camera is gone: unplugged, or its USB port was reset")

    @property
    def period_s(self) -> float:
        """Time between two shots, s."""
        return max(1.0 / self.workcell.timing.rate_hz, 1.0 / _PACE_HZ)

    def seen(self, shot: Shot) -> Shot:
        """Return a shot as it is with the lenses that are covered."""
        if not self._shown:  # the first images take 90 MB for a moment
            self._shown = True
            return_freed()
        dark = {
            side: np.full_like(image, 3) for side in self.person.covered if (image := getattr(shot, side)) is not None
        }
        return replace(shot, **dark)

    def close(self) -> None:
        """Do nothing: the workcell ends with the session."""

    def end(self) -> None:
        """End the workcell."""
        self.workcell.close()
