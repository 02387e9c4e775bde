"""A jump of the camera's clock that is not certain yet: how far estimates may be off by it.

What :mod:`.clock` follows is corrected once it is certain, which takes a second and more after a jump. Meanwhile the filter
takes what wrong stamps show for errors of the arm. An image that an offset explains better than chance begins a hypothesis
(Willsky and Jones, IEEE Trans. Automatic Control 21, 1976): the clock jumped then. What that makes of the filter's state
and of the images after it is known, so these confirm or refute it.
"""

from __future__ import annotations

import math

import numpy as np

from armsight.data import Array
from armsight.loop.estimators.clock import SYSTEMATIC_S, ClockFollower
from armsight.loop.estimators.errormodel import Predicted, StateStep

#: Sigmas from which on an image begins a hypothesis, and below which one is dropped; half: noise does, double: jumps of
#: some ms are taken for errors of the arm.
DOUBTED, REFUTED = 4.5, 2.0
SHOWN_S = 0.01  # s; an image that shows an offset no better than this begins none; half, double: nothing


class JumpingClock(ClockFollower):
    """Follows the camera's clock, and takes a jump that images showed before the filter used any."""

    def jump(self, offset_s: float, variance: float) -> None:
        """Correct stamps from now on by an offset, s, of a variance, s^2."""
        self.jumped(self._t_s if self.since_s is None else self.since_s, math.sqrt(variance))
        self._corrected[0] += offset_s


class ClockDoubt:
    """The likeliest jump of late.

    Args:
        delay: row of the delay in the filter's state.

    Attributes:
        t_s: the newest image, s.
    """

    def __init__(self, delay: int) -> None:
        self._delay, self.t_s = delay, -math.inf
        self._by = np.zeros(0)  # what an offset of a second makes of the state
        self._offset_s, self._variance = 0.0, math.inf

    def drop(self) -> None:
        """Doubt no more."""
        self._by, self._variance = np.zeros(0), math.inf

    def corrected(self, offset_s: float) -> None:
        """Take that stamps, and the filter's state, were corrected by an offset, s."""
        self._offset_s -= offset_s

    def step(self, t_s: float, steps: tuple[StateStep, ...], at: Predicted, arm: int) -> None:
        """Take how the filter came to its newest state since the image before.

        ``t_s``: time of the image, s, which was the last step. ``steps``: of the arm's error and what is beside.
        ``at``: as the image was predicted. ``arm``: count of the arm's error.
        """
        late, by, self.t_s = at.H[:, self._delay], self._by, t_s
        for step in steps:
            by = np.append(by, np.zeros(len(step.gain)))[: len(step.gain)]  # a unit came, or was dropped
            by[self._delay] = 0.0
            g = step.by @ by
            if step is steps[-1]:
                g = g + late
                self._tested(at.z, g, late, at.S)
                if len(self._by) == 0:  # begun by this image, or there is none
                    by[:], g = 0.0, late
            after = by.copy()
            after[:arm] *= step.kept
            if step.velocity is not None:
                after[arm : arm + 3] = step.velocity @ by
            by = after - step.gain @ g
        self._by = by if math.isfinite(self._variance) else np.zeros(0)

    def _tested(self, z: Array, g: Array, late: Array, S: Array) -> None:
        """Confirm or refute a jump by an image; begin with this one where that is likelier."""
        fresh, now = np.linalg.solve(S, late), np.linalg.solve(S, g)
        information, score = float(fresh @ late), float(fresh @ z)
        if math.isfinite(self._variance):
            self._offset_s += float(now @ (z - g * self._offset_s)) / (1.0 / self._variance + float(now @ g))
            self._variance = 1.0 / (1.0 / self._variance + float(now @ g))
            if abs(self._offset_s) < REFUTED * math.hypot(math.sqrt(self._variance), SYSTEMATIC_S):
                self.drop()
        held = self._offset_s**2 / self._variance
        if information > SHOWN_S**-2 and score**2 / information > max(DOUBTED**2, held):
            self.drop()
            self._offset_s, self._variance = score / information, 1.0 / information

    @property
    def sigma(self) -> Array | None:
        """One sigma (K,) of what the jump does to the arm's error as the filter has it; None where there is none."""
        if not len(self._by):
            return None
        out = self._by * math.hypot(self._offset_s, math.sqrt(self._variance), SYSTEMATIC_S)
        out[self._delay] = 0.0
        return out
