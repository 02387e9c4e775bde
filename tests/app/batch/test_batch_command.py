"""armsight batch: one row a shot and one a recording, the same by one and by two workers, and on again where it was."""

import json
import pickle
import re
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("distributed")
pytest.importorskip("mcap")

from armsight.app.batch.report import _of_result
from armsight.app.batch.run import Batch, _keys, _load, found_recordings, run_batch
from armsight.app.batch.work import BatchOptions, Done, work
from armsight.errors import InputError
from cli_runs import assert_has, assert_rejected

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture
def archive(tmp_path, rendered):
    """Three short recordings, and a file that is none."""
    import shutil

    source = rendered.folder / "arm"
    lines = (source / "shots.csv").read_text().splitlines()
    for k in range(3):
        folder = tmp_path / "archive" / f"take{k}"
        folder.mkdir(parents=True)
        chosen = lines[1 + k : 3 + k]
        (folder / "shots.csv").write_text("\n".join([lines[0], *chosen]) + "\n")
        for line in chosen:
            for name in line.split(",")[2:4]:
                shutil.copy(source / name, folder / name)
    broken = tmp_path / "archive" / "take3"
    broken.mkdir()
    (broken / "shots.csv").write_text("shot,t_s\n")
    return tmp_path / "archive"


def tables(folder):
    from pyarrow import parquet

    return [parquet.read_table(folder / name).to_pylist() for name in ("recordings.parquet", "shots.parquet")]


@pytest.fixture(scope="module")
def clusters():
    """The addresses of clusters of one and of two workers, in this process; benchmarks/record.py has processes."""
    from distributed import LocalCluster

    options = {"processes": False, "threads_per_worker": 1, "dashboard_address": ":0", "silence_logs": 50}
    with LocalCluster(n_workers=1, **options) as one, LocalCluster(n_workers=2, **options) as two:
        yield one.scheduler_address, two.scheduler_address


def test_one_and_two_workers_give_the_same_tables_and_it_goes_on(archive, rendered, tmp_path, clusters):
    options = BatchOptions("measure", str(rendered.rig), str(rendered.plate))
    one, two = clusters
    said = []
    done = run_batch(Batch([str(archive / "take*")], tmp_path / "one", options, workers=one), said.append)
    assert (done.recordings, done.ok, done.failed, done.before, done.shots) == (4, 3, 1, 0, 6)
    recordings, shots = tables(tmp_path / "one")
    assert [row["status"] for row in recordings] == ["ok", "ok", "ok", "failed"]
    assert "take3/shots.csv: line 1: expected the columns" in recordings[3]["reason"]
    assert [row["recording"] for row in recordings] == [str(archive / f"take{k}") for k in range(4)]
    assert all(row["status"] == "ok" and row["x_m"] is not None for row in shots)
    assert json.loads((tmp_path / "one" / "batch.json").read_text())["options"]["operation"] == "measure"
    again = run_batch(Batch([str(archive / "take*")], tmp_path / "two", options, workers=two), said.append)
    assert again.before == 0
    assert tables(tmp_path / "two") == [recordings, shots]
    # started again, after one part was lost
    next((tmp_path / "two" / "parts").iterdir()).unlink()
    parts = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "two" / "parts").iterdir()}
    last = run_batch(Batch([str(archive / "take*")], tmp_path / "two", options, workers=one), said.append)
    assert last.before == 2  # one failed before
    assert tables(tmp_path / "two") == [recordings, shots]
    assert all((tmp_path / "two" / "parts" / name).stat().st_mtime_ns == time for name, time in parts.items())


def test_only_a_few_recordings_are_handed_out_at_a_time(monkeypatch):
    """So the scheduler holds the same however many there are."""
    import armsight.app.batch.run as module

    class Future:
        def __init__(self, key, path):
            self.key, self.path = key, path

        def result(self):
            return Done({"recording": self.path, "status": "ok", "reason": None}, [])

        def release(self):
            held.discard(self.key)

    class Client:
        def submit(self, work, path, options, **how):
            held.add(path)
            most.append(len(held))
            return Future(path, path)

    class Completed(list):
        add = list.append

    held, most = set(), []
    monkeypatch.setattr("distributed.as_completed", Completed)
    paths = [f"{k:05d}" for k in range(10_000)]
    found = [path for path, _ in module._results(Client(), paths, BatchOptions("measure"), 8)]
    assert found == paths
    assert max(most) <= 8


def test_a_recording_that_fails_is_a_row_with_its_reason(tmp_path):
    done = work(str(tmp_path / "none.bag"), BatchOptions("measure", target="chessboard:9x6:25mm"))
    assert done.recording["status"] == "failed"
    assert "no such file or folder" in done.recording["reason"]
    assert done.shots == []


def test_what_failed_is_tried_again_and_makes_the_exit_code_1(armsight, tmp_path, clusters):
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("hello\n")
    arguments = ("batch", "identify", tmp_path / "*.csv", "-o", tmp_path / "out", "--arm", "six_r")
    for workers in (1, clusters[0]):  # a process of its own, and another's cluster
        done = armsight(*arguments, "--workers", workers)
        assert done.code == 1, done.err
        assert_has(done.out, "2 recordings: 0 done, 0 of them before, 2 failed", "  failed 2 times: ")
        assert list((tmp_path / "out" / "parts").iterdir()) == []
    assert (tmp_path / "out" / "recordings.parquet").is_file()


def test_what_all_recordings_share_is_opened_first(armsight, tmp_path):
    (tmp_path / "a.bag").write_text("hello\n")
    bad = ("batch", "measure", tmp_path / "a.bag", "-o", tmp_path / "out")
    assert_rejected(armsight(*bad, "--rig", tmp_path / "none.json"), "none.json: no such file")
    assert_rejected(armsight(*bad, "--target", tmp_path / "none.toml"), "none.toml: no such file")
    assert_rejected(armsight(*bad, "--arm", "none"), "arm 'none' is unknown")
    assert not (tmp_path / "out").exists()


def test_results_that_were_stored_hold_no_programs(tmp_path):
    stored = tmp_path / "part"
    stored.write_bytes(pickle.dumps(({"recording": "a"}, [])))
    with pytest.raises(InputError, match="part: not"):
        _load(stored)


def test_check_and_identify_take_the_data_of_their_commands(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "check")
    from test_check_command import file_of, rows_of

    (tmp_path / "run").mkdir()
    file_of(tmp_path / "run" / "check.csv", rows_of())
    checked = work(str(tmp_path / "run"), BatchOptions("check"))
    assert checked.recording["status"] == "ok"
    assert set(json.loads(checked.recording["result"])["poses"]) == {f"P{k}" for k in range(1, 6)}
    compared = _of_result(json.loads(checked.recording["result"]))
    assert (
        compared["circle.circularity_m"] == json.loads(checked.recording["result"])["circle"]["circularity_m"]["clean"]
    )
    assert not any(name.endswith((".raw", ".sigma")) for name in compared)
    failed = work(str(tmp_path / "run" / "check.csv"), BatchOptions("identify", arm="six_r"))
    assert "no joint angles; columns q1_rad" in failed.recording["reason"]


def test_a_run_s_arm_rig_and_summary_are_in_its_row(tmp_path, monkeypatch):
    from armsight.app.batch import work as module
    from armsight.app.stream.datum import Published
    from armsight.app.stream.mcap_file import McapSink, properties
    from armsight.robot.arm_file import open_arm
    from armsight.sim.example_rig import example_rig

    monkeypatch.setitem(module.OPERATIONS, "replay", lambda path, options: ({"shots": 0}, []))
    rig = replace(example_rig(), provenance={"made_utc": "2026-10-03T07:00:00+00:00"})
    sink = McapSink(tmp_path / "run.mcap", Published(properties=properties(rig, None, open_arm("six_r"))))
    sink.start()
    sink.close()
    delay = {"value": 0.013, "sigma": 0.001}
    (tmp_path / "summary.json").write_text(json.dumps({"wall_s": 7.0, "camera_delay_s": delay, "handeye": None}))
    for path in (tmp_path, tmp_path / "run.mcap"):
        row = work(str(path), BatchOptions("replay")).recording
        assert row["arm"] == "six_r"
        assert re.fullmatch("2026-10-03 [0-9a-f]{8}", row["rig"])
        assert _of_result(json.loads(row["result"])) == {"camera_delay_s": 0.013}
    (tmp_path / "summary.json").write_text("[")
    assert work(str(tmp_path), BatchOptions("replay")).recording["result"] is None


def test_another_rig_file_of_the_same_name_is_another_batch(tmp_path):
    (tmp_path / "rig.json").write_text("{}")
    options = BatchOptions("measure", str(tmp_path / "rig.json"))
    first = _keys({"a.bag": "1 2"}, options)
    assert _keys({"a.bag": "1 2"}, options) == first
    assert _keys({"a.bag": "1 3"}, options) != first
    (tmp_path / "rig.json").write_text("{ }")
    assert _keys({"a.bag": "1 2"}, options) != first


def test_recordings_are_found_in_any_store(tmp_path):
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.pipe("/a/x.bag", b"1")
    memory.pipe("/a/b/y.bag", b"2")
    assert list(found_recordings(["memory://a/**/*.bag"])) == ["memory:///a/b/y.bag", "memory:///a/x.bag"]
    assert (
        "damaged"
        in work("memory:///a/x.bag", BatchOptions("measure", target="chessboard:9x6:25mm")).recording["reason"]
    )
    memory.rm("/a", recursive=True)
    with pytest.raises(InputError, match="no such recording; quote the pattern"):
        found_recordings([str(tmp_path / "*.bag")])


def test_mistakes_are_one_line(armsight, tmp_path):
    bad = ("batch", "measure", tmp_path / "*.bag", "-o", tmp_path / "out", "--target", "chessboard:9x6:25mm")
    assert_rejected(armsight(*bad), "no such recording")
    assert_rejected(armsight("batch", "identify", "*.csv", "-o", tmp_path / "out"), "needs the nominal arm: give --arm")
    assert_rejected(armsight(*bad, "--workers", "many"), "a number of processes, or the address")
    assert list(tmp_path.iterdir()) == []
