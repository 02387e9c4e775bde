"""Cells and a hub, each with its own zenoh session, over loopback."""

import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from datetime import datetime, timedelta

import cv2
import numpy as np
import pytest

from armsight.app.hub.keys import make_keys, sign_hold
from armsight.app.hub.router import hold
from armsight.app.hub.service import Hub
from armsight.app.stream.cell import open_cell, tilt_and_size
from armsight.app.stream.datum import Published
from armsight.data import Missed, PoseEstimate, Shot
from armsight.errors import InputError
from armsight.loop.running.data import NoteDatum, ShotDatum
from armsight.sim.example_rig import example_rig

GREY = np.zeros((48, 64), np.uint8)


@pytest.fixture
def hub_at(tmp_path):
    """Return what starts hubs that are closed at the end."""
    hubs = []

    def start(port, keys=None, folder="hub"):
        scheme = "tcp" if keys is None else "tls"
        hubs.append(Hub(tmp_path / folder, f"{scheme}/127.0.0.1:{port}", "127.0.0.1:0", keys, lambda line: None))
        return hubs[-1]

    yield start
    for each in hubs:
        each.close()


@pytest.fixture
def cell_at():
    """Return what starts cells that are closed at the end."""
    cells = []

    def start(spec, mode="measure", **about):
        cells.append(open_cell(str(spec), Published(properties={"command": mode}, **about)))
        cells[-1].start()
        return cells[-1]

    yield start
    for each in cells:
        each.close()


def shown(hub):
    """Return the cells of a hub by name."""
    return {cell["name"]: cell for cell in hub.snapshot()["cells"]}


def fetched(hub, path):
    """Return the bytes of a page."""
    with urllib.request.urlopen(hub.pages.address + path, timeout=5) as answer:
        return answer.read()


def test_a_cell_that_began_before_its_hub_arrives_with_all_its_events(hub_at, cell_at, port, wait, monkeypatch):
    monkeypatch.setattr("armsight.app.stream.cell._SHOT_S", 60.0)
    cell = cell_at(f"table-1@127.0.0.1:{port}", temperatures_c=lambda: np.array([30.0, 41.2]))
    cell.put(NoteDatum(1.0, "rig: a camera moved", "warning", ("rig: a camera moved",)))
    hub = hub_at(port)
    for number in range(30):
        cell.put(ShotDatum(Shot(str(number), GREY, GREY), Missed("hidden")))
    wait(lambda: shown(hub).get("table-1", {}).get("state", {}).get("shots") == 30)
    found = wait(lambda: (f := shown(hub)["table-1"])["about"] and f)
    assert found["about"]["mode"] == "measure"
    assert (found["level"], found["why"]) == (3, "rig: a camera moved")
    assert found["state"]["temperature_c"] == 41.2
    assert [each["kind"] for each in json.loads(fetched(hub, "events?q=camera+moved"))] == ["health"]
    assert fetched(hub, "image?site=site&cell=table-1").startswith(b"\xff\xd8")
    assert json.loads(fetched(hub, "shots?site=site&cell=table-1")) == []  # none is kept before somebody asks
    for number in range(30):
        cell.put(ShotDatum(Shot(str(number), GREY, GREY), Missed("hidden")))
    (one,) = wait(lambda: json.loads(fetched(hub, "shots?site=site&cell=table-1")))  # of 30 within a minute
    assert (one["status"], one["reason"]) == ("missed", "hidden")
    assert "day" not in json.loads(fetched(hub, "state"))["cells"][0]
    assert json.loads(fetched(hub, "state?day=1"))["cells"][0]["day"] == []
    assert 'armsight_cell_missed_ratio{site="site",cell="table-1"}' in fetched(hub, "metrics").decode()
    cell.put(NoteDatum(2.0, "no longer found: rig: a camera moved", "info", ()))
    wait(lambda: shown(hub)["table-1"]["level"] != 3)
    cell.close()
    wait(lambda: shown(hub)["table-1"]["level"] == -1)
    assert [each["kind"] for each in json.loads(fetched(hub, "events"))] == ["ended", "health", "health", "began"]


def test_of_long_shots_as_many_are_sent_as_a_hub_reads(hub_at, cell_at, port, wait):
    hub, cell = hub_at(port), cell_at(f"a@127.0.0.1:{port}")
    wait(lambda: shown(hub).get("a", {}).get("about"))
    for bytes_each, numbers in ((13_967, "1234"), (13_106, "1234"), (13_105, "01234"), (70_000, "")):
        cell._kept.extend((time.monotonic(), json.dumps(f"{k}".ljust(bytes_each - 2)).encode()) for k in range(5))
        assert [each.strip() for each in json.loads(fetched(hub, "shots?site=site&cell=a"))] == list(numbers)


def test_a_storm_of_findings_is_thinned_counted_and_said(hub_at, cell_at, port, wait):
    """What arrives, what the outbox left out and what the queue before it dropped are all."""
    hub, cell = hub_at(port), cell_at(f"a@127.0.0.1:{port}")
    for number in range(3000):
        cell.put(NoteDatum(0.0, f"storm {number}", "warning"))
    wait(lambda: not cell._queue)
    cell.close()
    wait(lambda: shown(hub)["a"]["level"] == -1)
    events = hub._store.events()
    left_out = sum(int(each["text"].split()[0]) for each in events if each["kind"] == "thinned")
    assert left_out + sum(each["kind"] == "health" for each in events) == 3000
    assert left_out > 2500


def test_events_arrive_once_although_the_hub_is_killed(hub_at, cell_at, port, tmp_path, wait):
    code = (
        "import sys, threading; from pathlib import Path; from armsight.app.hub.service import Hub;"
        f"Hub(Path({str(tmp_path / 'kept')!r}), 'tcp/127.0.0.1:{port}', '127.0.0.1:0', None, print);"
        "print('up', flush=True);"
        "threading.Event().wait()"
    )
    cell = cell_at(f"a@127.0.0.1:{port}")
    for killed in range(2):
        hub = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=os.environ)
        assert hub.stdout.readline() == "up\n"
        cell.put(NoteDatum(0.0, f"before {killed}", "warning"))
        wait(lambda: not cell._outbox.waiting(999))
        hub.kill()
        hub.communicate()
        cell.put(NoteDatum(0.0, f"while it is gone {killed}", "warning"))
    hub = hub_at(port, folder="kept")
    wait(lambda: len(hub._store.events()) == 5)
    assert [each["n"] for each in hub._store.events()] == [5, 4, 3, 2, 1]


def test_a_killed_cell_is_lost_and_one_that_ends_is_not(hub_at, port, tmp_path, wait):
    hub = hub_at(port)
    code = (
        "import sys, time; from armsight.app.stream.cell import open_cell; from armsight.app.stream.datum import Published;"
        f"c = open_cell('b@127.0.0.1:{port}', Published()); c.start(); time.sleep(60)"
    )
    cell = subprocess.Popen([sys.executable, "-c", code], env=os.environ)
    wait(lambda: shown(hub).get("b", {}).get("state"))
    cell.kill()
    cell.wait()
    assert wait(lambda: (f := shown(hub)["b"])["level"] == 4 and f)["why"].startswith("lost")
    hub.close()
    later = hub_at(port, folder="hub")
    assert shown(later)["b"]["level"] == 4  # it is not forgotten


def test_one_name_is_one_process(cell_at, port, hub_at, wait, monkeypatch, tmp_path):
    cell_at(f"a@127.0.0.1:{port}")
    with pytest.raises(InputError, match="another command of this cell runs"):
        cell_at(f"a@127.0.0.1:{port}")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another computer"))
    cell_at(f"a@127.0.0.1:{port}")
    hub = hub_at(port)
    assert wait(lambda: (f := shown(hub).get("a", {})).get("level") == 1 and f)["why"].startswith("2 processes")


def test_no_thread_of_a_cell_is_in_zenoh_when_its_command_ends(cell_at, hub_at, port, wait):
    """CPython before 3.14 ends such a thread by unwinding it, and Rust aborts the process: exit code 134."""
    cell = cell_at(f"a@127.0.0.1:{port}")  # where no hub is
    time.sleep(0.4)  # it begins to connect after 0.25 s, and tries for a second
    cell.close()
    assert not cell._post.is_alive()
    hub = hub_at(port)
    answering = cell_at(f"b@127.0.0.1:{port}")
    wait(lambda: shown(hub).get("b", {}).get("about"))
    answering.close()
    assert len(answering._answering) >= 3
    assert not any(each.is_alive() for each in answering._answering)


def test_the_exit_code_of_a_command_is_its_last_event(hub_at, port, tmp_path, wait, armsight):
    example_rig().save(tmp_path / "rig.json")
    for side in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{side}0.png"), GREY)
    hub = hub_at(port)
    hub._asking.submit = lambda *given: None  # it ends before it is asked who it is
    shot, cell = ("--source", tmp_path, "--stream"), f"cell:a@127.0.0.1:{port}"
    said = armsight("measure", tmp_path / "rig.json", "--target", "chessboard:9x6:25mm", *shot, cell)
    assert said.code == 2
    found = wait(lambda: (f := shown(hub).get("a", {})).get("level") == 1 and f)
    assert "ended after 0 shots with exit code 2: " in found["why"]
    assert found["why"].endswith("measure at the size the rig was calibrated at")
    assert not hub._store.known()[0].sessions
    assert hub._store.known()[0].need(0.0)[::2] == (1, found["why"])  # after a restart, too
    assert armsight("record", tmp_path, "-o", tmp_path / "kept", "--stream", cell).code == 0
    found = wait(lambda: (f := shown(hub)["a"])["level"] == -1 and f)
    assert found["why"] == "armsight record ended after 1 shots with exit code 0"


def with_line(path, old, new):
    """Change a file, and return its path."""
    path.write_text(path.read_text().replace(old, new))
    return path


def test_a_cell_writes_below_its_own_name_alone(hub_at, cell_at, port, tmp_path, wait):
    make_keys(tmp_path / "keys", "lab", ["a", "b"], "127.0.0.1", port)
    make_keys(tmp_path / "other", "lab", ["c"], "127.0.0.1", port)
    hub = hub_at(port, tmp_path / "keys")
    cell_at(with_line(tmp_path / "keys/cells/b/cell.toml", 'name = "b"', 'name = "x"'))
    cell_at(tmp_path / "other/cells/c/cell.toml")
    cell_at(tmp_path / "keys/cells/a/cell.toml")
    wait(lambda: shown(hub).get("a", {}).get("state"))
    wait(lambda: len(hub._router.links()) == 2)
    hub._look()
    assert {each["cell"] for each in hub._store.events()} == {"a"}  # a cell that is about to begin is none
    hub._look()
    hub._look()  # it is said once
    assert set(shown(hub)) == {"a"}
    (found,) = [each for each in hub._store.events() if each["cell"] == "hub"]
    assert found["kind"] == "rejected"
    assert re.fullmatch(r"tls/127.0.0.1:\d+ has the key of b and sends under another name: .*", found["text"])


class Wire:
    """A relay that keeps what passes."""

    def __init__(self, to):
        self.passed, self._to = bytearray(), to
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self.thread = threading.Thread(target=self._accept, daemon=True)
        self.thread.start()

    def _accept(self):
        with self._listening:
            near = self._listening.accept()[0]
        with near, socket.create_connection(("127.0.0.1", self._to)) as far:
            back = threading.Thread(target=self._carry, args=(far, near), daemon=True)
            back.start()
            self._carry(near, far)
            back.join()

    def _carry(self, one, other):
        with contextlib.suppress(OSError):
            while data := one.recv(1 << 16):
                self.passed += data
                other.sendall(data)
            other.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize("secret", [True, False])
def test_who_listens_on_the_wire_sees_no_state(secret, hub_at, cell_at, port, tmp_path, wait):
    """Without keys, on one computer, it is seen: the words that are looked for are those that are sent."""
    if secret:
        make_keys(tmp_path / "keys", "lab", ["a"], "127.0.0.1", port)
    hub, wire = hub_at(port, tmp_path / "keys" if secret else None), Wire(port)
    spec = f"a@127.0.0.1:{wire.port}"
    if secret:
        spec = with_line(tmp_path / "keys/cells/a/cell.toml", f":{port}", f":{wire.port}")
    cell = cell_at(spec)
    wait(lambda: (f := shown(hub).get("a", {})).get("state") and f["about"])
    cell.close()
    wire.thread.join()
    assert all((word in wire.passed) is not secret for word in (b"armsight", b"error_mm", b"rig_heldout_mm"))


def test_a_connection_without_a_key_is_rejected_and_that_is_an_event(port, tmp_path, wait):
    make_keys(tmp_path / "keys", "lab", ["a"], "127.0.0.1", port)
    listen = ["--listen", f"tls/127.0.0.1:{port}", "--keys", tmp_path / "keys", "--http", "127.0.0.1:0"]
    command = [sys.executable, "-m", "armsight", "hub", *listen, "-o", tmp_path / "hub", "--json"]
    hub = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    address = json.loads(hub.stdout.readline())["address"]
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", port)) as plain:
            plain.sendall(b"GET / HTTP/1.0\r\n\r\n")
            plain.recv(100)

    def events():
        with urllib.request.urlopen(address + "events", timeout=5) as answer:
            return json.load(answer)

    found = wait(events)
    assert [(each["site"], each["cell"], each["kind"]) for each in found] == [
        ("lab", "hub", "rejected")
    ]  # not one each
    hub.terminate()
    out, err = hub.communicate()
    assert out == ""
    assert f"note: {found[0]['text']}\n" in err


def test_a_cell_holds_for_the_key_of_its_site_alone(hub_at, cell_at, port, tmp_path, wait, monkeypatch):
    keys = tmp_path / "keys"
    make_keys(keys, "lab", ["arm", "shy", "done"], "127.0.0.1", port)
    hub, held = hub_at(port, keys), []

    def ended(why):
        raise InputError("nothing moves any more")

    cell_at(with_line(keys / "cells/arm/cell.toml", "holds = false", "holds = true"), "run", hold=held.append)
    cell_at(keys / "cells/shy/cell.toml", "run", hold=held.append)
    cell_at(with_line(keys / "cells/done/cell.toml", "holds = false", "holds = true"), "run", hold=ended)
    wait(lambda: set(shown(hub)) == {"arm", "shy", "done"} and all(cell["about"] for cell in shown(hub).values()))
    assert hold(keys, "shy", "why", f"127.0.0.1:{port}").startswith("rejected: this cell does not allow it")
    assert hold(keys, "done", "smoke", f"127.0.0.1:{port}") == "rejected: nothing moves any more"
    wait(lambda: any("rejected: nothing moves" in each["text"] for each in hub._store.events()))
    assert [each["kind"] for each in hub._store.events() if each["cell"] == "done"] == ["hold", "began"]
    assert held == []
    assert hold(keys, "arm", "smoke", f"127.0.0.1:{port}") == "held"
    assert held == ["the hub asked to hold: smoke"]
    request = json.dumps({"t": 0, "text": "", "signature": "00"}).encode()
    assert hub._router.ask("lab", "arm", "hold", request).startswith(b"rejected: it is not signed")
    with pytest.raises(InputError, match="no cell of site lab"):
        hold(keys, "nobody", "", f"127.0.0.1:{port}")
    assert len(held) == 1
    again = sign_hold(keys, "arm", "again")
    assert hub._router.ask("lab", "arm", "hold", again) == b"held"
    assert hub._router.ask("lab", "arm", "hold", again) == b"rejected: it was done before"

    class Earlier(datetime):
        @classmethod
        def now(cls, tz=None):
            return datetime.now(tz) - timedelta(seconds=90)

    monkeypatch.setattr("armsight.app.hub.keys.datetime", Earlier)
    assert b"it is old" in hub._router.ask("lab", "arm", "hold", sign_hold(keys, "arm", "old"))
    assert len(held) == 2


def test_an_address_beyond_this_computer_needs_keys(tmp_path):
    with pytest.raises(InputError, match="is another computer"):
        Hub(tmp_path, "tcp/0.0.0.0:7447", "127.0.0.1:0", None, print)
    with pytest.raises(InputError, match="needs the keys of a site"):
        Hub(tmp_path, "tls/0.0.0.0:7447", "127.0.0.1:0", None, print)


def test_thirty_tabs_are_one_look_at_the_cells(hub_at, port, monkeypatch):
    monkeypatch.setattr("armsight.app.hub.service._STATE_S", 600.0)
    hub = hub_at(port)
    assert len({fetched(hub, "state") for _ in range(30)}) == 1


def test_a_page_of_another_name_is_answered_nothing(hub_at, port):
    request = urllib.request.Request(hub_at(port).pages.address + "state", headers={"Host": "elsewhere.example:80"})
    with pytest.raises(urllib.error.HTTPError) as error:
        urllib.request.urlopen(request, timeout=5)
    assert error.value.code == 403
    error.value.close()


@pytest.mark.parametrize("axis", [0, 1])
def test_a_rotation_of_one_camera_shows_in_tilt_or_size(axis):
    """The oracle: projections by the true rig, the pose triangulated by the old one.

    About x the rays leave their planes by the angle itself; about y the depth, and with it the size, changes by Z / b
    times it: within 5 %, as the body is 0.1 m off the axis. About z, the optical axis, neither shows.
    """
    from armsight.data import Body, Correspondences
    from armsight.vision.pose.locate import locate
    from armsight.vision.triangulate import triangulate

    rig = example_rig()
    points = np.array([[-0.04, -0.04, 0], [0.04, -0.04, 0.01], [0.04, 0.04, 0], [-0.04, 0.04, -0.01], [0, 0, 0.02]])
    body = Body("body", tuple("ABCDE"), points)
    tangent = np.zeros(rig.parameter_count)
    tangent[rig.parameter_count - 3 + axis] = np.radians(0.01)
    found = []
    for each in (rig, rig.perturbed(tangent)):
        T = np.eye(4)
        T[:3, 3] = 0.1, 0.05, 0.85
        uv = np.stack(each.project(points @ T[:3, :3].T + T[:3, 3]), axis=1)
        seen = Correspondences(np.arange(5), uv, np.tile(0.01 * np.eye(2), (5, 2, 1, 1)))
        pose = locate(rig, body, triangulate(rig, body, seen))
        assert isinstance(pose, PoseEstimate)
        found.append(tilt_and_size(rig, points, pose))
    assert found[0] == pytest.approx((0.0, 0.0), abs=1e-9)
    changed, expected = np.abs(np.subtract(*found)), np.radians(0.01) * np.array([1.0, 0.85 / rig.baseline_m])
    assert changed[axis] == pytest.approx(expected[axis], rel=0.05)
    assert changed[1 - axis] < 0.05 * expected[1 - axis]


def test_events_of_an_earlier_command_do_not_end_this_one(hub_at, cell_at, port, wait):
    """The order in which they come, in batches of any size, is that in which they were made."""
    hub = hub_at(port)
    cell_at(f"a@127.0.0.1:{port}")
    wait(lambda: shown(hub).get("a", {}).get("level") == 0)
    old = {"level": "info", "text": "", "t": 1.0}
    for n, kind in enumerate(("ended", "began", "nothing"), start=1):
        hub._stored("site", "a", {"outbox": "x", "events": [{**old, "kind": kind, "n": n}, 7]})
    wait(hub._heard.empty)
    with hub._lock:
        assert not hub._cells["site", "a"].ended
    hub._stored("site", "a", {"outbox": "x", "events": [{**old, "kind": "ended", "n": 4}]})
    wait(lambda: hub._cells["site", "a"].ended)
