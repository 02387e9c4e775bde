"""A device whose line to the host is disturbed."""

import numpy as np


class NoisyDevice:
    """A device behind a line of which a share of the bytes is changed or lost, both ways."""

    def __init__(self, device, share, seed):
        self.device, self.share, self._rng = device, share, np.random.default_rng(seed)

    t_s = property(lambda self: self.device.t_s)

    def write(self, data):
        self.device.write(self._disturbed(data))

    def read(self):
        return self._disturbed(self.device.read())

    def step(self):
        self.device.step()

    def _disturbed(self, data):
        hit, lost = self._rng.random(len(data)) < self.share, self._rng.random(len(data)) < 0.5
        noise = self._rng.integers(0, 256, len(data))
        return bytes(int(noise[k]) if hit[k] else each for k, each in enumerate(data) if not (hit[k] and lost[k]))
