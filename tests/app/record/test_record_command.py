"""Recording: what is stored comes back, and whatever stops it leaves a readable recording and says how much."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from armsight.app.main import main
from armsight.app.record import recording
from armsight.app.record.recording import record
from armsight.data import Shot
from armsight.errors import DeviceError, InputError
from armsight.vision import sources
from armsight.vision.sources import FolderSource, open_source
from cli_runs import listening

rng = np.random.default_rng(20240611)


def noise(shape=(24, 32, 3), dtype=np.uint8):
    return rng.integers(0, np.iinfo(dtype).max + 1, shape, dtype=dtype)


class Played:
    """A source that hands out a list; an exception in it is raised."""

    def __init__(self, items):
        self.items = list(items)

    def read(self):
        item = self.items.pop(0) if self.items else None
        if isinstance(item, BaseException):
            raise item
        return item

    def close(self):
        self.items = []


def some(count, shape=(24, 32, 3)):
    return [Shot(f"{k:06d}", noise(shape), noise(shape), 5.0 + k / 30) for k in range(count)]


def read_back(folder):
    source, found = FolderSource.open(folder), []
    while (shot := source.read()) is not None:
        found.append(shot)
    return found


def assert_same(found, shots):
    assert [shot.name for shot in found] == [shot.name for shot in shots]
    for a, b in zip(found, shots, strict=True):
        assert a.problem == b.problem
        assert a.t_s == (None if b.t_s is None else pytest.approx(b.t_s, abs=5e-7))  # stored to the microsecond
        for side in ("left", "right"):
            x, y = a.image(side), b.image(side)
            assert (x is None) == (y is None)
            assert x is None or (x.dtype == y.dtype and np.array_equal(x, y))


def assert_nothing_else(folder, shots):
    """The folder holds the index, two files a shot with images, and by the command run.mcap; nothing half-written."""
    names = [path.name for path in folder.iterdir() if path.name != "run.mcap"]
    assert len(names) == 1 + 2 * sum(shot.problem is None for shot in shots)


@pytest.mark.opencv
def test_what_was_recorded_comes_back_bit_by_bit(tmp_path):
    shots = [
        *some(2),
        Shot("grey", noise((24, 32)), noise((24, 32)), 6.0),
        Shot("deep", noise((24, 32), np.uint16), noise((24, 32, 3), np.uint16), 6.1),
        Shot("bad, very", None, None, 6.2, 'left: "cut"\nshort'),
        Shot("timeless", noise(), noise()),
    ]
    result = record(Played(shots), tmp_path / "new" / "folder")
    assert (result.shots, result.problems, result.stopped) == (6, 1, None)
    shots[4] = Shot("bad, very", None, None, 6.2, 'left: "cut" short')
    assert_same(read_back(result.directory), shots)
    assert_nothing_else(result.directory, shots)


def test_what_is_odd_about_images_is_said_at_the_end(tmp_path, armsight):
    record(Played([Shot("a", *[np.full((24, 32), 900, np.uint16)] * 2)]), tmp_path / "a")
    said = armsight("record", tmp_path / "a", "-o", tmp_path / "b")
    assert said.err.count("note: its 16-bit images are read as 10 bits, which hold their pixels") == 1


def test_a_recording_of_a_recording_is_the_same(tmp_path):
    record(Played(some(3)), tmp_path / "a")
    record(open_source(f"folder:{tmp_path / 'a'}"), tmp_path / "b")
    assert (tmp_path / "a" / "shots.csv").read_text() == (tmp_path / "b" / "shots.csv").read_text()
    assert_same(read_back(tmp_path / "b"), read_back(tmp_path / "a"))


def test_it_stops_after_so_many_shots_or_seconds(tmp_path):
    assert record(Played(some(9)), tmp_path / "a", shots=4).shots == 4
    assert record(Played(some(9)), tmp_path / "b", seconds=0.1001).shots == 4  # at 0, 1/30, 2/30 and 3/30 s
    assert record(Played(some(2)), tmp_path / "c", shots=4).shots == 2


def test_seconds_of_a_source_without_time_are_the_clocks(tmp_path, monkeypatch):
    now = iter(np.arange(100.0, 110.0, 0.5))
    monkeypatch.setattr(recording, "time", type("Clock", (), {"monotonic": staticmethod(lambda: next(now))}))
    timeless = [Shot(str(k), noise(), noise()) for k in range(9)]
    assert record(Played(timeless), tmp_path / "a", seconds=1.9).shots == 3  # at 0.5, 1.0 and 1.5 s


@pytest.mark.parametrize(
    ("stop", "said", "interrupted"),
    [(KeyboardInterrupt(), "interrupted", True), (DeviceError("/dev/video0: gone"), "/dev/video0: gone", False)],
)
def test_what_stops_the_source_leaves_what_was_stored(tmp_path, stop, said, interrupted):
    shots = some(3)
    result = record(Played([*shots, stop, *some(2)]), tmp_path / "a")
    assert (result.shots, result.stopped, result.interrupted) == (3, said, interrupted)
    assert_same(read_back(result.directory), shots)
    assert_nothing_else(result.directory, shots)


MOMENTS = {"first image": "left000002", "second image": "right000002", "index": "shots.csv"}


@pytest.fixture(params=MOMENTS)
def at_moment(request, monkeypatch):
    """Have two functions called at a moment within the third shot, with what is written: an image, or an index line."""

    def arranged(at_image, at_line):
        replacing, write, lines = recording.replacing, os.write, []

        def own_replacing(path, mode="w", **how):
            if path.name.startswith(MOMENTS[request.param]):
                at_image(path)
            return replacing(path, mode, **how)

        def own_write(handle, data):
            lines.append(data)
            return write(handle, at_line(data) if request.param == "index" and len(lines) == 4 else data)

        monkeypatch.setattr(recording, "replacing", own_replacing)
        monkeypatch.setattr(recording.os, "write", own_write)
        return MOMENTS[request.param]

    return arranged


def test_a_disk_that_fills_within_a_shot_leaves_none_of_it(tmp_path, at_moment):
    def fail(path):
        raise InputError(f"{path}: cannot be written: {os.strerror(errno.ENOSPC)}")

    shots, file = some(4), at_moment(fail, lambda data: data[:7])  # half a line gets out
    result = record(Played(shots), tmp_path / "a")
    assert result.shots == 2
    assert file in result.stopped
    assert result.stopped.endswith("cannot be written: No space left on device")
    assert_same(read_back(result.directory), shots[:2])
    assert_nothing_else(result.directory, shots[:2])


def test_an_interrupt_within_a_shot_waits_until_it_is_stored(tmp_path, at_moment):
    def interrupt(data):
        signal.raise_signal(signal.SIGINT)
        return data

    shots = some(5)
    at_moment(interrupt, interrupt)
    before = signal.getsignal(signal.SIGINT)
    result = record(Played(shots), tmp_path / "a")
    assert signal.getsignal(signal.SIGINT) == before
    assert (result.shots, result.stopped, result.interrupted) == (3, "interrupted", True)
    assert_same(read_back(result.directory), shots[:3])
    assert_nothing_else(result.directory, shots[:3])


def test_another_thread_can_record(tmp_path):
    results = []
    thread = threading.Thread(target=lambda: results.append(record(Played(some(2)), tmp_path / "a")))
    thread.start()
    thread.join()
    assert results[0].shots == 2


def test_a_full_disk_keeps_what_fitted(small_disk):
    disk, shots = small_disk("256k"), some(40, (64, 64, 3))  # two files of 12 kB each: about ten fit
    result = record(Played(shots), disk / "a")
    assert 5 <= result.shots < 11
    assert result.stopped.endswith("cannot be written: No space left on device")
    assert_same(read_back(result.directory), shots[: result.shots])
    assert_nothing_else(result.directory, shots[: result.shots])


def test_a_folder_in_use_is_not_touched(tmp_path):
    record(Played(some(1)), tmp_path / "a")
    before = {path: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    with pytest.raises(InputError, match="already holds a recording; record into a new folder"):
        record(Played(some(1)), tmp_path / "a")
    assert {path: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before
    (tmp_path / "file").write_text("here")
    with pytest.raises(InputError, match="is not empty; record into a new folder"):
        record(Played(some(1)), tmp_path)
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match=f"{folder}: no recording can be made here: Not a directory"):
            record(Played(some(1)), folder)
    with pytest.raises(InputError, match="/proc/none: no recording can be made here: No such file or directory"):
        record(Played(some(1)), "/proc/none")  # found out before the first shot


def test_without_a_single_shot_there_is_no_recording(tmp_path):
    result = record(Played([DeviceError("gone")]), tmp_path / "a")
    assert (result.shots, result.stopped) == (0, "gone")
    assert not (tmp_path / "a").exists()
    assert record(Played(some(1)), tmp_path / "a").shots == 1


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["armsight", *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        main()
    out, err = capsys.readouterr()
    return caught.value.code, out, err


@pytest.fixture
def stored(tmp_path):
    record(Played([*some(2), Shot("2", None, None, 6.0, "left: cut short"), *some(5)[3:]]), tmp_path / "in")
    return tmp_path / "in"


def test_the_command_stores_and_says_so(monkeypatch, capsys, stored, tmp_path):
    code, out, err = run(monkeypatch, capsys, "record", stored, "-o", tmp_path / "a")
    assert (code, out) == (
        0,
        f"5 shots are stored in {tmp_path / 'a'}, 1 of them without images: shots.csv has the reasons\n",
    )
    assert "Traceback" not in err
    code, out, _ = run(monkeypatch, capsys, "record", stored, "-o", tmp_path / "b", "--shots", 2, "--json")
    assert code == 0
    assert json.loads(out) == {"directory": str(tmp_path / "b"), "shots": 2, "problems": 0, "stopped": None}


def test_the_commands_mistakes_are_one_line_and_code_2(monkeypatch, capsys, stored, tmp_path):
    for arguments, said in (
        (
            ("film:x", "-o", tmp_path / "a"),
            "film:x: not a source: known are folder:..., pairs:..., video:..., url:..., usb:...",
        ),
        (("0,1", "-o", tmp_path / "a"), "0,1: not a source (usb:0,1?): known are folder:"),
        (("nope:", "-o", tmp_path / "a"), "nope: not a source: known are folder:"),
        (("0", "-o", tmp_path / "a"), "0: not a source (usb:0,1?): known are folder:"),
        ((stored, "-o", stored), f"{stored}: already holds a recording; record into a new folder"),
        (("usb:97,98", "-o", tmp_path / "a"), "/dev/video97: no such camera; `armsight cameras` lists those attached"),
    ):
        code, out, err = run(monkeypatch, capsys, "record", *arguments)
        assert (code, out) == (2, "")
        assert [line for line in err.splitlines() if line.strip()][-1].startswith(f"armsight: error: {said}")
    assert not (tmp_path / "a").exists()
    code, _, err = run(monkeypatch, capsys, "record", stored, "-o", tmp_path / "a", "--shots", 0)
    assert code == 2
    assert "--shots" in err


def test_a_stop_in_the_middle_is_a_partial_result_that_says_so(monkeypatch, capsys, tmp_path):
    for stop, expected, said in (
        (DeviceError("/dev/video0: gone"), 2, "armsight: error: /dev/video0: gone; 3 shots are stored in"),
        (KeyboardInterrupt(), 130, "armsight: interrupted; 3 shots are stored in"),
    ):
        monkeypatch.setattr(sources, "open_source", lambda _, stop=stop: Played([*some(3), stop]))
        folder = tmp_path / str(expected)
        code, out, err = run(monkeypatch, capsys, "record", "any", "-o", folder, "--json")
        assert code == expected
        assert json.loads(out)["shots"] == 3
        assert said in err.replace("\n", " ")
        assert len(read_back(folder)) == 3


#: A process that records from cameras that never stop by themselves: only the interrupt ends it.
ENDLESS = """
import itertools, time
import numpy as np
from armsight.app.main import main
from armsight.data import Shot
from armsight.vision import sources

class Endless:
    def __init__(self):
        self.names = map(str, itertools.count())
    def read(self):
        time.sleep(0.01)
        return Shot(next(self.names), *np.full((2, 24, 32), 7, np.uint8), 0.0)
    def close(self):
        print("closed")

sources.open_source = lambda spec: Endless()
main()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_of_a_real_process(tmp_path, number):
    """A recording without an end, interrupted as soon as some of it is stored."""
    folder = tmp_path / "a"
    process = subprocess.Popen(
        [sys.executable, "-c", ENDLESS, "record", "any", "-o", folder],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ,
        preexec_fn=listening,
    )
    while process.poll() is None and not Path(folder, "right000004.png").exists():
        time.sleep(0.01)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    found = read_back(folder)
    assert process.returncode == 130
    assert f"armsight: interrupted; {len(found)} shots are stored in" in err
    assert "Traceback" not in out + err
    assert "closed" in out
    assert len(found) >= 4
    assert_nothing_else(folder, found)
