"""Host times converted to the board's clock, and cameras that a thread reads."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.data import Shot
from armsight.errors import DeviceError
from armsight.loop.running.setup import DRIFT, HostClock, LiveShots

OFFSET_S = 12345.678


class Clock:
    """A host's clock set by hand."""

    def __init__(self):
        self.s = 0.0

    def __call__(self):
        return self.s


def heard(rng, drift, seconds, *, pause=None, way_s=1e-3):
    """Readings received every 4 ms, late by the shortest transmission and up to 3 ms more, sometimes much more.

    Returns (board's time, host's time converted to the board's clock) of each, from 1 s on.
    """
    now = Clock()
    clock, rows = HostClock(now), []
    for board_s in np.arange(0.004, seconds, 0.004):
        late = way_s + rng.uniform(0.0, 3e-3) + (0.05 if rng.uniform() < 0.05 else 0.0)
        if pause is not None and pause[0] < board_s < pause[1]:
            late += 0.03
        host_s = OFFSET_S + (1 + drift) * board_s
        now.s = host_s + late
        clock.heard(board_s)
        if board_s > 1.0:
            rows.append((board_s, clock.on_board(Shot("1", None, None, host_s)).t_s))
    return np.array(rows)


@pytest.mark.parametrize("drift", [0.0, 50e-6, -50e-6, 1.5e-4, -1e-3])
def test_stamps_are_converted_to_the_boards_clock_up_to_the_shortest_transmission(drift):
    rows = heard(np.random.default_rng(0), drift, 60.0)
    off = rows[:, 1] - rows[:, 0]
    # Taken late by h above the least: h is so that 250 readings a second, uniform over 3 ms, bring it down as fast as it
    # may rise: (250 / 3 ms) h h / 2 = DRIFT - drift; four times that is rare. A constant is the delay's to take up.
    h = np.sqrt(2 * max(DRIFT - drift, 0.0) * 3e-3 / 250)
    assert np.abs(off.mean() + 1e-3) < 2 * h + abs(drift) * 0.02
    assert np.ptp(off) < 8 * h + abs(drift) * 0.1


def test_a_host_that_is_busy_for_some_time_does_not_disturb_the_clock():
    rows = heard(np.random.default_rng(1), 50e-6, 12.0, pause=(5.0, 9.0))
    off = rows[:, 1] - rows[:, 0] + 1e-3
    assert np.abs(off).max() < 4.1 * DRIFT + 2e-4  # it rises meanwhile, no faster than clocks drift
    after = off[rows[:, 0] > 9.2]
    assert np.abs(after).max() < 2e-4  # and is back with the first readings


def test_once_the_rate_is_known_a_busy_host_moves_the_clock_by_less_than_clocks_may_drift():
    rows = heard(np.random.default_rng(2), 5e-5, 70.0, pause=(50.0, 65.0))
    off = rows[rows[:, 0] > 40.0]
    off = off[:, 1] - off[:, 0] + 1e-3
    assert np.abs(off).max() < 0.25 * DRIFT * 15.0
    rows = heard(np.random.default_rng(3), 5e-5, 70.0)
    assert np.abs(np.diff(rows[rows[:, 0] > 60.0], axis=1) + 1e-3).max() < 1.5e-4


@pytest.mark.parametrize(
    ("t_s", "said"),
    [(None, "has no time"), (np.nan, "has no time"), (3.0, "was taken 12343 s ago"), (1.7e9, "was taken -")],
)
def test_shots_of_a_recording_are_rejected(t_s, said):
    now = Clock()
    clock = HostClock(now)
    now.s = OFFSET_S
    clock.heard(1.0)
    with pytest.raises(DeviceError, match=f"shot 7 {said}.*live cameras"):
        clock.on_board(Shot("7", None, None, t_s))
    assert clock.on_board(Shot("8", None, None, None, "torn")).problem == "torn"


class Reads:
    """A source of one shot, and then of a given end."""

    def __init__(self, end):
        self.end, self.left, self.closed = end, [Shot("1", None, None, 1.0)], False
        self.taken = threading.Event()

    def read(self):
        if self.left:
            return self.left.pop(0)
        self.taken.wait(10.0)
        if self.end is not None:
            raise self.end
        return None

    def close(self):
        self.closed = True


def polled_until_it_raises(shots):
    while True:
        assert shots.poll() is None


@pytest.mark.parametrize(
    ("end", "said"),
    [
        (None, "the source of images has ended"),
        (DeviceError("left camera: gone"), "left camera: gone"),
        (ZeroDivisionError("of ours"), "reading the cameras failed: ZeroDivisionError: of ours"),
        (MemoryError(), "reading the cameras failed: MemoryError"),
    ],
)
def test_whatever_ends_the_reading_is_raised_by_poll(end, said):
    source = Reads(end)
    shots = LiveShots(source)
    assert shots.poll() is None  # nothing is read before the start
    assert source.left
    shots.start()
    first = None
    while first is None:
        first = shots.poll()
    assert first.name == "1"
    source.taken.set()
    with pytest.raises(DeviceError, match=said):
        polled_until_it_raises(shots)
    shots.close()
    assert source.closed


class Paced(Reads):
    """Cameras whose shots are so far apart by their stamps, s, with a stall; then they are silent."""

    def __init__(self, apart_s):
        super().__init__(None)
        self.times = iter(np.cumsum(apart_s))

    def read(self):
        t_s = next(self.times, None)
        if t_s is None:
            self.taken.wait()
        return None if t_s is None else Shot("shot", None, None, float(t_s))


def test_the_rate_of_cameras_is_that_of_their_stamps_whatever_a_stall_does(monkeypatch):
    shots = LiveShots(Paced([0.5, *[0.04] * 12]))
    shots.start()
    assert shots.rate_hz() == (pytest.approx(25.0), True)
    monkeypatch.setattr("armsight.loop.running.setup.RATE_S", 0.05)
    source = Paced([0.1, 0.1])
    slow = LiveShots(source)
    slow.start()
    with pytest.raises(DeviceError, match="2 shots came"):
        slow.rate_hz()
    source.taken.set()


def test_shots_without_stamps_have_the_rate_at_which_they_come(monkeypatch):
    clock = iter(0.05 * np.arange(1000))
    monkeypatch.setattr(
        "armsight.loop.running.setup.time", SimpleNamespace(monotonic=lambda: next(clock), sleep=time.sleep)
    )
    shots = LiveShots(Paced([np.nan] * 12))
    shots.start()
    while len(shots._times) < 12:
        time.sleep(0.001)
    assert shots.rate_hz() == (pytest.approx(20.0), False)


def rate_of(*stamps_s):
    """Return the rate of a source of shots with these stamps, s, which then ends."""
    source = Reads(None)
    source.left = [Shot("shot", None, None, t_s) for t_s in stamps_s]
    source.taken.set()
    shots = LiveShots(source)
    shots.start()
    return shots.rate_hz()


@pytest.mark.parametrize("count", [3, 5, 12, 40])
def test_a_source_that_ends_has_the_rate_of_the_shots_that_it_had(count):
    assert rate_of(*(0.04 * np.arange(count))) == (pytest.approx(25.0), True)


@pytest.mark.parametrize("count", [0, 2])
def test_a_source_that_ends_too_early_says_so(count):
    with pytest.raises(DeviceError, match="the source of images has ended"):
        rate_of(*range(count))


@pytest.mark.parametrize(
    ("stamps_s", "rate_hz"),
    [
        ([1.0] * 12, None),
        ([None] * 12, None),
        ([np.nan] * 12, None),
        ([*np.arange(12.0, 0.0, -1.0)], None),
        ([*(1e-6 * np.arange(12))], None),
        ([*(10.0 * np.arange(12))], None),
        ([0.0, None, 0.1, 0.2, np.nan, 0.3, 0.4, 0.4, 0.3, 0.4], 10.0),
    ],
)
def test_times_that_are_missing_or_do_not_rise_are_no_rate(stamps_s, rate_hz):
    assert rate_of(*stamps_s) == ((None, False) if rate_hz is None else (pytest.approx(rate_hz), True))
