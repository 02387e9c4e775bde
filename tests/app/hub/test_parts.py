"""The parts of a hub by themselves: who a cell is, its outbox, its keys, drifts, the order of cells, the store, a push."""

import errno
import json
import math
import threading
import time
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.hub.cells import CHANCE, FINDING, LOOK, LOST, WELL, CellView, Slopes, drifts, look_for_drifts, ranked
from armsight.app.hub.keys import make_keys, site_of
from armsight.app.hub.push import push
from armsight.app.hub.router import parsed
from armsight.app.hub.store import Store
from armsight.app.stream.cell_file import Cell, read_cell
from armsight.app.stream.outbox import Outbox
from armsight.errors import InputError
from cli_runs import assert_has, assert_rejected


def test_who_a_cell_is(tmp_path):
    assert read_cell("table-1") == Cell("table-1")
    assert read_cell("a@localhost:17").router == "tcp/localhost:17"
    path = tmp_path / "cell.toml"
    path.write_text('name = "b"\nsite = "lab"\nholds = true\n')
    assert read_cell(str(path)) == Cell("b", "lab", holds=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a/b", "expected up to 31 letters"),
        ("a b", "expected up to 31 letters"),
        ("", "expected up to 31 letters"),
        ("a@host", "is no address of a hub"),
        ("a@host:70000", "is no address of a hub"),
        ("a@10.0.0.7:7447", "is another computer"),
        ("a@tls/10.0.0.7:7447", "needs ca, certificate and key"),
        ("none.toml", "no such file"),
    ],
)
def test_a_wrong_name_is_one_line(text, message, armsight, tmp_path):
    arguments = ("measure", tmp_path / "rig.json", "--target", "x.toml", "--source", "pairs:l*.png,r*.png")
    assert_rejected(armsight(*arguments, "--stream", f"cell:{text}"), message)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("nmae = 1", "unknown key 'nmae'"),
        ("name = 1", "name is 1: expected a text"),
        ('site = "x"', "the key name is missing"),
        ('name = "a"\nholds = "yes"', "expected true or false"),
        ('name = "a"\nca = "none.pem"', "none.pem is not there"),
    ],
)
def test_a_wrong_file_is_one_line(line, message, tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(line + "\n")
    with pytest.raises(InputError, match=message):
        read_cell(str(path))


def test_events_wait_on_disk_until_they_are_confirmed(tmp_path):
    box = Outbox(tmp_path, "a")
    for k in range(5):
        box.add({"text": str(k)}, thin=True)
    box.confirm(2)
    name = box.name
    box.close()
    box = Outbox(tmp_path, "a")
    assert box.name == name
    assert [(each["n"], each["text"]) for each in box.waiting(80)] == [(3, "2"), (4, "3")]
    box.confirm(5)
    box.add({"text": "next"}, thin=True)
    assert [each["n"] for each in box.waiting(9)] == [6]
    box.close()


def test_a_storm_of_events_is_thinned_counted_and_said(tmp_path, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    box = Outbox(tmp_path, "a")
    for k in range(3000):
        now[0] += 1e-3
        box.add({"kind": "health", "level": "warning", "text": str(k)}, thin=True)
    assert 100 <= len(box.waiting(10**9)) <= 100 + 10 * 3 + 2
    now[0] += 10.0
    box.add({"kind": "health", "level": "warning", "text": "after"}, thin=False)
    *_, said, last = box.waiting(10**9)
    assert (said["kind"], last["text"]) == ("thinned", "after")
    left_out = 3000 - sum(each["kind"] == "health" for each in box.waiting(10**9)) + 1
    assert said["text"].startswith(f"{left_out} events or shots were left out")
    box.close()


def test_keys_are_made_once_and_renewed_before_their_end(tmp_path, monkeypatch):
    keys = tmp_path / "keys"
    assert [path.parent.name for path in make_keys(keys, "lab", ["a"], "hub.local", 7447)] == ["a"]
    assert make_keys(keys, "lab", ["a", "b"], "hub.local", 7447) == [keys / "cells/b/cell.toml"]
    assert site_of(keys) == ("lab", ["a", "b"])
    assert make_keys(keys, "lab", ["a", "b"], "hub.local", 7448) == [keys / f"cells/{n}/cell.toml" for n in "ab"]
    assert read_cell(str(keys / "cells/b/cell.toml")).router == "tls/hub.local:7448"
    make_keys(keys, "lab", ["a", "b"], "hub.local", 7447)
    assert (keys / "ca.key").stat().st_mode & 0o077 == 0
    assert read_cell(str(keys / "cells/a/cell.toml")).router == "tls/hub.local:7447"
    with pytest.raises(InputError, match="keys of site lab, not of other"):
        make_keys(keys, "other", [], "hub.local", 7447)
    toml = keys / "cells/a/cell.toml"
    toml.write_text(toml.read_text().replace("holds = false", "holds = true"))
    with pytest.raises(InputError, match="cannot be called hub"):
        make_keys(keys, "lab", ["hub"], "hub.local", 7447)

    class Later(datetime):
        @classmethod
        def now(cls, tz=None):
            return datetime.now(tz) + timedelta(days=380)

    for module in ("armsight.app.hub.keys", "armsight.app.stream.cell_file"):
        monkeypatch.setattr(f"{module}.datetime", Later)
    assert make_keys(keys, "lab", ["a", "b"], "new.local", 7447) == [keys / f"cells/{n}/cell.toml" for n in "ab"]
    assert read_cell(str(toml)).holds  # what its owner changed stays
    monkeypatch.setattr(Later, "now", classmethod(lambda cls, tz=None: datetime.now(UTC) + timedelta(days=900)))
    for read in (lambda: site_of(keys), lambda: read_cell(str(toml))):
        with pytest.raises(
            InputError, match=r"\.pem: valid from 2027-.* and this computer's date is 2029-.*run `armsight"
        ):
            read()
    monkeypatch.setattr(Later, "now", classmethod(lambda cls, tz=None: datetime.now(UTC) + timedelta(days=4000)))
    with pytest.raises(InputError, match=r"ca\.pem: valid from .*, or make the keys in a new folder"):
        make_keys(keys, "lab", ["a"], "hub.local", 7447)


def slopes(rng, per_h, blocks=30):
    found = Slopes()
    for k in range(blocks):
        found.add(10.0 * k, per_h * k / 360.0 + 0.05 * rng.standard_normal())
    return found


def test_a_slope_is_that_of_numpy():
    rng = np.random.default_rng(5)
    found = slopes(rng, 3.0)
    t, y = np.array(found.blocks).T
    assert found.per_h(300.0, 30) == pytest.approx(3600.0 * np.polyfit(t, y, 1)[0], rel=1e-9)


def test_the_cells_that_drift_are_named_and_no_other():
    rng = np.random.default_rng(6)
    cells = {f"c{k}": slopes(rng, 30.0 if k in (3, 8) else 0.0) for k in range(30)}
    found = drifts(cells, 300.0)
    assert {name for name, each in found.items() if each.chance < CHANCE} == {"c3", "c8"}
    assert found["c3"].per_h == pytest.approx(30.0, abs=5 * found["c3"].sigma_per_h)
    alone = drifts({"c3": cells["c3"]}, 300.0)["c3"]  # nothing to compare with: nothing is said
    assert math.isnan(alone.sigma_per_h)
    assert alone.chance == 1.0


def state(t, **values):
    return {"t": t, "mode": "measure", "rate_hz": 30.0, "missed": 0.0, "error_mm": 0.05, "sigma_mm": 0.03, **values}


def connected(name, at_s, **values):
    cell = CellView("lab", name)
    cell.token("s", True, at_s)
    cell.take(state(at_s, **values), at_s)
    return cell


def test_the_order_is_who_needs_a_look():
    late = connected("frozen", 1000.0)
    gone = connected("gone", 1005.0)
    gone.token("s", False, 1005.0)
    ill = connected("ill", 1005.0, health=["rig: a camera moved"])
    clock = connected("clock", 1005.0)
    clock.take(state(1005.0 + 365 * 86400.0), 1005.0)
    many = connected("many", 1005.0)
    many.token("t", True, 1005.0)
    over = connected("over", 1005.0, error_mm=0.5)
    over.about = {"limit_mm": 0.1}
    blind = connected("blind", 1005.0, missed=0.9)
    well = connected("well", 1005.0)
    shown = ranked([well, blind, over, many, clock, ill, late, gone], 1006.0)
    assert [(each["name"], each["level"]) for each in shown[:3]] == [("frozen", LOST), ("gone", LOST), ("ill", FINDING)]
    assert {each["name"] for each in shown[3:7]} == {"over", "blind", "many", "clock"}
    assert {each["level"] for each in shown[3:7]} == {LOOK}
    assert (shown[-1]["name"], shown[-1]["level"]) == ("well", WELL)
    why = {each["name"]: each["why"] for each in shown}
    assert why["clock"] == "its clock is +31536000 s off the hub's"
    assert why["over"] == "error 0.50 mm, more than its limit of 0.10"


@pytest.mark.parametrize(
    "content", [None, [], {}, {"t": math.inf}, {"t": 10**400}, {"t": "now"}, "a message of 9 bytes"]
)
def test_what_is_no_state_is_counted(content):
    cell = connected("a", 1000.0)
    assert cell.take(content, 1001.0) is None
    assert cell.need(1001.0)[2].startswith("a message could not be read")
    cell.take(state(1062.0), 1062.0)
    assert cell.need(1062.0)[0] == WELL


def test_a_state_of_another_version_is_read():
    cell = connected("a", 1000.0)
    assert (
        cell.take({"t": 1001.0, "more": [1], "missed": "none", "health": 7, "error_mm": True}, 1001.0)["missed"] is None
    )
    assert cell.need(1001.0)[0] == WELL
    look_for_drifts({("lab", "a"): cell}, 1001.0)
    assert cell.drifts == {}


def test_the_store_keeps_each_event_once_and_finds_it(tmp_path):
    store = Store(tmp_path)
    event = {"kind": "health", "level": "warning", "text": "rig: 100% off_axis", "t": 5.0}
    message = {"outbox": "x", "events": [{**event, "n": n} for n in (1, 2, 3)]}
    assert store.add_events("lab", "a", message, 6.0) == 3
    assert store.add_events("lab", "a", message, 7.0) == 3
    assert store.add_events("lab", "a", {"events": []}, 7.0) == 0
    ahead = {"outbox": "y", "events": [{**event, "n": 1, "t": 5.0 + 365 * 86400, "text": "of a clock a year ahead"}]}
    assert store.add_events("lab", "b", ahead, 5.5) == 1
    assert [(each["cell"], each["n"]) for each in store.events()] == [("a", 3), ("a", 2), ("a", 1), ("b", 1)]
    assert store.count() == 4
    assert len(store.events("RIG off_axis")) == 3
    assert store.events("rig offXaxis") == store.events("'; DROP TABLE events") == []
    with pytest.raises(InputError, match="another hub uses it"):
        Store(tmp_path)
    cell = connected("a", 1000.0)
    store.add_state(cell, cell.state)
    store.close()
    duckdb = pytest.importorskip("duckdb")
    query = f"SELECT cell, day, error_mm FROM read_parquet('{tmp_path}/states/*/*/*.parquet', hive_partitioning = true)"
    assert [(str(c), str(d), e) for c, d, e in duckdb.sql(query).fetchall()] == [("lab.a", "1970-01-01", 0.05)]


def test_on_a_full_disk_the_cells_keep_their_events(tmp_path):
    store = Store(tmp_path)
    (pages,) = store._db.execute("PRAGMA page_count").fetchone()
    store._db.execute(f"PRAGMA max_page_count = {pages}")
    message = {"outbox": "x", "events": [{"n": n, "text": "x" * 2000} for n in range(1, 9)]}
    assert store.add_events("lab", "a", message, 6.0) == 0
    assert store.problem == "events are not stored, the cells keep them: database or disk is full"
    cell = connected("a", 1000.0)
    (tmp_path / "states").write_text("")  # nor can states be written
    store.add_state(cell, cell.state)
    store.flush()
    store._db.execute("PRAGMA max_page_count = 1000000")
    assert store.add_events("lab", "a", message, 7.0) == 8
    assert store.problem.startswith("states are not stored: ")
    store.close()


def test_numbers_in_names_count_as_numbers():
    cells = [CellView("lab", f"table-{n}", lost_s=0.0) for n in (10, 2, 1)]
    assert [each["name"] for each in ranked(cells, 1.0)] == ["table-1", "table-2", "table-10"]


def runs(folder):
    for name in ("one", "two"):
        (folder / name).mkdir(parents=True)
        (folder / name / "run.mcap").write_bytes(name.encode() * 1000)
        (folder / name / "summary.json").write_text("{}")
    return folder


def test_the_oldest_events_are_forgotten(tmp_path, monkeypatch):
    monkeypatch.setattr("armsight.app.hub.store._MOST", 10)
    store = Store(tmp_path)
    for n in range(1, 26):
        store.add_events("lab", "a", {"outbox": "x", "events": [{"n": n, "t": 0.0}]}, float(n))
    store.flush()
    assert sorted(each["n"] for each in store.events()) == list(range(16, 26))
    store.close()


def test_a_push_goes_on_where_it_was(tmp_path):
    folder, store, cell = runs(tmp_path / "runs"), tmp_path / "store", Cell("a", "lab")
    done = push(cell, folder, str(store), 100.0, lambda sent: None)
    assert (done.runs, done.files, done.complete_before) == (2, 4, 0)
    there = next(store.glob("lab/*/a/one"))
    manifest = json.loads((there / "manifest.json").read_text())
    assert set(manifest["files"]) == {"run.mcap", "summary.json"}
    (there / "manifest.json").unlink()
    (there / "run.mcap").write_bytes(b"half")
    again = push(cell, folder, str(store), 100.0, lambda sent: None)
    assert (again.runs, again.files, again.complete_before) == (1, 1, 1)
    assert (there / "run.mcap").read_bytes() == b"one" * 1000


@pytest.mark.parametrize(("link_s", "took_s"), [(0.0, 11.0), (0.5, 11.5), (1.0, 12.0), (2.0, 24.0)])
def test_a_push_keeps_its_rate_however_fast_the_link_is(tmp_path, monkeypatch, link_s, took_s):
    """12 pieces of a second each: a link that is as fast as the rate is used wholly."""
    now = [0.0]
    clock = SimpleNamespace(monotonic=lambda: now[0], sleep=lambda s: now.append(now.pop() + s))
    monkeypatch.setattr("armsight.app.hub.push.time", clock)
    monkeypatch.setattr("armsight.app.hub.push._CHUNK", 1000)
    (tmp_path / "runs/one").mkdir(parents=True)
    (tmp_path / "runs/one/run.mcap").write_bytes(b"x" * 12_000)
    push(Cell("a", "lab"), tmp_path / "runs", str(tmp_path / "store"), 1e-3, lambda sent: clock.sleep(link_s))
    assert now == pytest.approx([took_s])


def test_a_store_without_its_library_is_not_an_unknown_one(tmp_path, monkeypatch):
    from fsspec.registry import known_implementations

    store = {"class": "none_of_these.Store", "err": "Please install none_of_these"}
    monkeypatch.setitem(known_implementations, "lonely", store)
    with pytest.raises(InputError, match=r"^lonely://b: Please install none_of_these$"):
        push(Cell("a", "lab"), tmp_path, "lonely://b", 1.0, lambda sent: None)
    monkeypatch.delitem(known_implementations, "lonely")
    with pytest.raises(InputError, match=r"not known: lonely; expected a folder, or such as s3://bucket$"):
        push(Cell("a", "lab"), tmp_path, "lonely://b", 1.0, lambda sent: None)


def test_a_push_makes_no_bucket(tmp_path, armsight):
    """As s3fs: makedirs below a bucket that is not there makes it."""
    import fsspec
    from fsspec.implementations.memory import MemoryFileSystem

    class Buckets(MemoryFileSystem):
        protocol, store, pseudo_dirs, root_marker = "buckets", {}, [""], ""

        @classmethod
        def _strip_protocol(cls, path):
            return path.removeprefix("buckets://").strip("/")

    fsspec.register_implementation("buckets", Buckets, clobber=True)
    folder = runs(tmp_path / "runs")
    said = armsight("hub", "push", folder, "buckets://archvie/x", "--cell", "a")
    assert_rejected(said, "no 'archvie' is there, or it cannot be reached")
    assert not Buckets.store
    Buckets.pseudo_dirs.append("archive")
    assert armsight("hub", "push", folder, "buckets://archive/x", "--cell", "a", "--json").code == 0
    assert sum(name.endswith("manifest.json") for name in Buckets.store) == 2


def test_a_store_that_is_full_or_does_not_answer_is_one_line(tmp_path, armsight, monkeypatch):
    import asyncio

    import fsspec
    from fsspec.asyn import AsyncFileSystem
    from fsspec.implementations.memory import MemoryFileSystem

    class Silent(AsyncFileSystem):
        protocol = "silent"

        async def _exists(self, path, **kwargs):
            await asyncio.sleep(60.0)

    class Full(MemoryFileSystem):
        protocol, store, pseudo_dirs, root_marker = "full", {}, ["", "archive"], ""

        @classmethod
        def _strip_protocol(cls, path):
            return path.removeprefix("full://").strip("/")

        def _open(self, *arguments, **named):
            raise OSError(errno.ENOSPC, "No space left on device")

    class Stalled(Full):
        """Takes the first file, then nothing of the second one, as behind a cable that is cut."""

        protocol, store, pseudo_dirs = "stalled", {}, ["", "archive"]

        @classmethod
        def _strip_protocol(cls, path):
            return path.removeprefix("stalled://").strip("/")

        def _open(self, path, *arguments, **named):
            file = MemoryFileSystem._open(self, path, *arguments, **named)
            if len(self.store) > 1:
                file.write = lambda piece: ended.wait(30.0)
            return file

    ended = threading.Event()
    for kind in (Silent, Full, Stalled):
        fsspec.register_implementation(kind.protocol, kind, clobber=True)
    monkeypatch.setattr("armsight.app.hub.push._ANSWER_S", 0.2)
    folder = runs(tmp_path / "runs")
    said = armsight("hub", "push", folder, "silent://bucket", "--cell", "a")
    assert_rejected(said, "silent://bucket: no answer for 0 s; started again it goes on where it was")
    said = armsight("hub", "push", folder, "full://archive", "--cell", "a")
    assert_rejected(said, "full://archive: No space left on device; started again it goes on where it was")
    monkeypatch.setattr("armsight.app.hub.push._SLOWEST", 1e9)
    said = armsight("hub", "push", folder, "stalled://archive", "--cell", "a")
    ended.set()
    assert_rejected(said, "stalled://archive: no answer for 0 s; started again it goes on where it was")


def test_clocks_of_two_tables(tmp_path, armsight):
    t = np.arange(0.0, 12.0, 0.04)
    p = 0.05 * np.sin(np.outer(t, [2.0, 2.9, 4.1]) + np.arange(3.0))
    for name, late_s in (("one", 0.0), ("two", 100.25)):
        rows = [f"{a + late_s:.6f},{x:.9f},{y:.9f},{z:.9f},1,0,0,0" for a, (x, y, z) in zip(t, p, strict=True)]
        (tmp_path / f"{name}.csv").write_text("\n".join(["t_s,x_m,y_m,z_m,qw,qx,qy,qz", *rows]) + "\n")
    found = json.loads(armsight("hub", "clocks", tmp_path / "one.csv", tmp_path / "two.csv", "--json").out)
    assert found["delay_s"] == pytest.approx(100.25, abs=1e-5)
    said = armsight("hub", "clocks", tmp_path / "one.csv", tmp_path / "two.csv").out
    assert_has(said, "two.csv less those of ", "one.csv: +100250.0")
    assert_rejected(armsight("hub", "clocks", tmp_path / "one.csv", tmp_path / "none.csv"), "none.csv", "no such file")


def test_a_push_waits_for_its_cell_and_says_what_is_wrong(tmp_path, armsight):
    from armsight.app.stream.outbox import state_folder

    folder = runs(tmp_path / "runs")
    running = Outbox(state_folder() / "cells" / "site" / "a", "a")
    assert_rejected(armsight("hub", "push", folder, tmp_path / "store", "--cell", "a"), "another command of this cell")
    running.close()
    assert_rejected(armsight("hub", "push", tmp_path, tmp_path / "store", "--cell", "a"), "no runs are here")
    assert_rejected(armsight("hub", "push", folder, "nowhere://x", "--cell", "a"), "nowhere")
    assert_rejected(
        armsight("hub", "push", tmp_path, "nowhere://x", "--cell", "a"), "not known: nowhere; expected a folder"
    )
    assert json.loads(armsight("hub", "push", folder, tmp_path / "store", "--cell", "a", "--json").out)["runs"] == 2


def test_the_hub_says_what_is_wrong(tmp_path, armsight):
    assert_rejected(armsight("hub", "--listen", "0.0.0.0:7447", "-o", tmp_path / "h"), "is another computer")
    assert_rejected(
        armsight("hub", "--keys", tmp_path, "--listen", "tls/0.0.0.0:7", "-o", tmp_path / "h"), "no keys of a site"
    )
    assert_rejected(armsight("hub", "--http", "nowhere", "-o", tmp_path / "h"), "expected HOST:PORT")
    for address in ("hub.local:0", "hub.local:65536"):
        keys = armsight("hub", "keys", "lab", "--hub", address, "-o", tmp_path / "k")
        assert_rejected(keys, f"--hub is '{address}'", "expected HOST:PORT")
    assert_rejected(armsight("hub", "keys", "my lab", "-o", tmp_path / "k"), "expected up to 31 letters")
    assert_rejected(armsight("hub", "hold", "a", "why", "--keys", tmp_path), "no keys of a site are here")
    (tmp_path / "file").write_text("")
    assert_rejected(armsight("hub", "-o", tmp_path / "file"), "no hub can be kept here")


def test_a_clock_that_runs_fast_is_shown_with_its_rate():
    cell = CellView("lab", "a")
    for k in range(400):
        cell.take(state(1000.0 + k * 1.0001 + 0.5), 1000.0 + k)
    shown = cell.to_json(1400.0)
    assert shown["clock_s"] == pytest.approx(0.54, abs=0.001)
    assert shown["clock_s_per_h"] == pytest.approx(0.36, rel=0.01)


def test_half_a_pair_of_utf_16_is_stored_as_a_question_mark(tmp_path):
    """JSON may hold what no text of UTF-8 is; it stopped the hub, and its cell sent the same events for ever."""
    store, cell = Store(tmp_path), CellView("lab", "a")
    sent = b'{"outbox": "x", "events": [{"n": 1, "t": 5.0, "text": "a\\ud800"}], "t": 5.0, "health": ["\\udc00"]}'
    assert store.add_events("lab", "a", parsed(sent), 5.0) == 1
    assert [each["text"] for each in store.events()] == ["a?"]
    store.add_state(cell, cell.take(parsed(sent), 5.0))
    store.close()
    assert store.problem == ""
    assert parsed(b"") == "a message that is no JSON"
    assert parsed(bytes(10_000_000)) == "a message of 10000000 bytes: at most 65536 are read"


def test_unreadable_events_do_not_hold_up_the_others(tmp_path):
    store = Store(tmp_path)
    good = {"kind": "health", "level": "warning", "text": "x", "t": math.inf}
    message = {"outbox": "x", "events": [{**good, "n": 1}, 7, {"n": "two"}, {"n": 1e300}, {**good, "n": 3}]}
    assert store.add_events("lab", "a", message, 6.0) == 3
    assert [(each["n"], each["t"]) for each in store.events()] == [(3, 6.0), (1, 6.0)]
    assert store.add_events("lab", "a", "a message of 70000 bytes", 6.0) == 0
    store.close()


def test_a_batch_of_events_is_no_longer_than_a_hub_reads(tmp_path):
    from armsight.app.stream.cell import _BATCH_BYTES
    from armsight.app.stream.cell_file import LONGEST
    from armsight.app.stream.datum import json_text

    box = Outbox(tmp_path, "a")
    for k in range(80):
        box.add({"kind": "health", "level": "warning", "text": '\u00e9"' * 999, "t": 1e9 + k}, thin=False)
    found = box.waiting(_BATCH_BYTES)
    assert 1 < len(found) < 80
    assert len(json_text({"outbox": box.name, "events": found})) < LONGEST
    assert len(box.waiting(1)) == 1  # one at least
    box.close()


def test_a_cell_that_joins_is_compared_with_as_short_windows():
    """White noise: a slope over 15 blocks is eight times as steep by chance as one over 60."""
    false = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        cells = {f"c{k}": Slopes() for k in range(20)}
        for block in range(75):
            for name in cells if block >= 60 else list(cells)[1:]:
                cells[name].add(10.0 * block, rng.standard_normal())
        false += drifts(cells, 750.0)["c0"].chance < CHANCE
    assert false == 0


def test_old_windows_and_those_of_another_session_are_not_compared():
    cell = connected("a", 1000.0)
    for key in cell.slopes:
        for k in range(30):
            cell.slopes[key].add(1000.0 + 10.0 * k, float(k))
    assert cell.slopes["tilt_mdeg"].per_h(1300.0, 30) == pytest.approx(360.0)
    assert cell.slopes["tilt_mdeg"].per_h(1900.0, 30) is None
    cell.token("s", False, 1300.0)
    cell.token("t", True, 1301.0)
    assert cell.slopes["tilt_mdeg"].count(1301.0) == 0


def test_a_cell_is_frozen_although_the_hub_s_clock_was_set_back():
    cell = connected("a", 10_000.0)
    assert cell.need(10_000.0 - 3600.0)[0] == LOST
    cell.take(state(6401.0), 6401.0)
    assert cell.need(6402.0)[0] == WELL


def test_a_cell_by_itself_is_compared_with_its_own_past():
    """The hub looks while the next block is being filled: the window is complete all the same."""
    rng, cell = np.random.default_rng(8), Slopes()
    for block in range(600 + 60):
        slope = 100.0 * max(block - 600, 0) / 360.0
        cell.add(10.0 * block, 0.05 * rng.standard_normal() + slope)
        alone = drifts({"a": cell}, 10.0 * block + 14.0)
        if block == 599:
            assert alone["a"].sigma_per_h > 0.0
            assert alone["a"].chance > CHANCE
    assert alone["a"].chance < CHANCE
