"""Noise on the line between a host and an emulated controller."""

from __future__ import annotations

import numpy as np

from armsight.sim.boards.device import Device


class NoisyDevice:
    """A device behind a disturbed line: bytes both ways are changed or lost.

    Args:
        device: the controller.
        share: of the bytes that are disturbed.
        seed: of the noise.
    """

    def __init__(self, device: Device, share: float, seed: int = 0) -> None:
        self.device, self.share = device, share
        self._rng = np.random.default_rng(seed)

    @property
    def t_s(self) -> float:
        """How much time has passed, s."""
        return self.device.t_s

    def write(self, data: bytes) -> None:
        """Take bytes from the host."""
        self.device.write(self._disturbed(data))

    def read(self) -> bytes:
        """Return the bytes that have left for the host."""
        return self._disturbed(self.device.read())

    def step(self) -> None:
        """Let a step pass."""
        self.device.step()

    def _disturbed(self, data: bytes) -> bytes:
        if not data:
            return data
        hit = self._rng.random(len(data)) < self.share
        lost = self._rng.random(len(data)) < 0.5
        noise = self._rng.integers(0, 256, len(data))
        return bytes(int(noise[k]) if hit[k] else each for k, each in enumerate(data) if not (hit[k] and lost[k]))
