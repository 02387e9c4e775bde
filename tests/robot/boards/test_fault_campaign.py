"""A piece of the benchmark's fault campaign: nothing is violated, and what it looks at would be found."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from armsight.robot.boards.emulators import open_emulator
from armsight.robot.boards.frames import ANSWER, REQUEST

PATH = Path(__file__).resolve().parents[3] / "benchmarks" / "board_faults.py"


@pytest.fixture(scope="module")
def campaign():
    """The benchmark's module."""
    spec = importlib.util.spec_from_file_location("board_faults", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_nothing_is_violated_by_any_kind_of_fault(campaign):
    found = campaign.Campaign(open_emulator("host"), 3, campaign.limits()).run(120)
    assert found.violations == []
    assert set(found.faults) == set(campaign.KINDS)
    assert max(found.fastest.values()) < campaign.CATCHING_UP
    assert max(found.slowest_link_ticks.values()) <= campaign.LINK_TICKS


class Changed:
    """The firmware with something wrong: its answers, or the requests to it, are changed."""

    def __init__(self, *, answer=lambda frame: None, request=lambda frame: None):
        self.emulator, self.answer, self.request = open_emulator("host"), answer, request

    def tick(self, request):
        asked = np.frombuffer(bytearray(request), REQUEST)
        self.request(asked[0])
        said = np.frombuffer(bytearray(self.emulator.tick(asked.tobytes())), ANSWER)
        self.answer(said[0])
        return said.tobytes()

    def close(self):
        self.emulator.close()


def never_releases(frame):
    """Drives stay on with the last duties, whatever the firmware says."""
    outputs = frame["outputs"]
    if outputs["faults"] & 0x6FE and not outputs["drives_on"]:  # faults that release
        outputs["drives_on"], outputs["duty"] = 1, 0.3


def blind_to_supply(frame):
    frame["supply_mv"] = 12000


def forgets_numbers(frame):
    frame["outputs"]["acknowledged_sequence"] += 1


def overdrives(frame):
    """Full drive wherever any is asked for."""
    frame["outputs"]["duty"] = np.sign(frame["outputs"]["duty"])


@pytest.mark.parametrize(
    ("change", "kind", "found"),
    [
        ({"answer": never_releases}, "dip", "leaves the drives on"),
        ({"request": blind_to_supply}, "dip", "SUPPLY_LOW of joint None is reported as None"),
        ({"answer": forgets_numbers}, "flip", "as acknowledged last, the core"),
        ({"answer": overdrives}, "jump", "before the next one strikes"),
    ],
)
def test_a_firmware_with_a_mistake_is_found(campaign, monkeypatch, change, kind, found):
    monkeypatch.setattr(campaign, "KINDS", (kind,))
    outcome = campaign.Campaign(Changed(**change), 3, campaign.limits()).run(8)
    assert any(found in each for each in outcome.violations), outcome.violations[:5]


def test_noise_strikes_as_it_is_set(campaign):
    noise = campaign.Noise(np.random.default_rng(1))
    data = bytes(range(60))
    assert noise.to_board(1, data) == noise.to_host(1, data) == data
    noise.strike("flip", False, 1)
    flipped = noise.to_board(1, data)
    assert sum(bin(a ^ b).count("1") for a, b in zip(flipped, data, strict=True)) == 1
    assert noise.to_board(2, data) == data
    noise.strike("drop", True, 1)
    assert noise.to_board(1, data) == data
    assert 1 <= len(data) - len(noise.to_host(1, data)) <= 20
    noise.strike("burst", False, 4)
    assert all(noise.to_board(tick, data) != data for tick in (2, 3, 4))
    assert (noise.to_board(5, data), noise.last_bad) == (data, 4)
