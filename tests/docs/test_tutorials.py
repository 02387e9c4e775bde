"""The tutorials' commands run in the order in which their pages have them, and make the pictures that they show."""

import contextlib
import json
import re
import shlex
import sys
from pathlib import Path

import pytest

from armsight.app.run import command as run_command
from armsight.app.run import motion_file
from armsight.loop.running import calibrate as run_calibrate
from cli_runs import run

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.insert(0, str(DOCS))
import run_tutorials  # noqa: E402
from run_tutorials import PAGES, Runner, blocks, pictures  # noqa: E402


def execute(command, folder, by_shell=run_tutorials.execute):
    """Run a command of a page; ours in this process, where what it imports is imported."""
    program, *arguments = shlex.split(command)
    if program != "armsight":
        return by_shell(command, folder)
    with contextlib.chdir(folder):
        assert not run(*arguments), command


@pytest.fixture(scope="module")
def runner(tmp_path_factory, quick_demo, example_recording):
    runner = Runner(tmp_path_factory.mktemp("tutorials"))
    runner.take(("armsight demo --quick -o demo",), quick_demo)
    runner.take(("python examples/05_render_a_recording.py recording --small",), example_recording)
    return runner


def test_every_tutorial_is_run():
    listed = set(re.findall(r"^(\w+)$", (DOCS / "tutorials/index.md").read_text(encoding="utf-8"), re.MULTILINE))
    tutorials = {page.removeprefix("tutorials/") for page in PAGES if not page.startswith("arms/")}
    assert tutorials == listed | {"start"}
    assert listed == {path.stem for path in (DOCS / "tutorials").glob("*.md")} - {"index"}


def assert_run_as_devices_are(folder, demo):
    """Hold a run on the workcell, which is named as devices are, to what is known of devices."""
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["ended_by"] is None
    assert summary["camera_delay_s"]["value"] == pytest.approx(13e-3, abs=1e-3)
    assert not (folder / "truth.csv").exists()
    assert (folder / "report.html").exists()
    assert (folder / "body.toml").read_text() == (demo / "body.toml").read_text()
    assert "as planned" in (folder / "run.log").read_text()


@pytest.mark.parametrize("page", PAGES)
def test_the_commands_run_and_make_the_pictures(runner, page, monkeypatch):
    monkeypatch.setattr(run_tutorials, "execute", execute)
    monkeypatch.setattr(run_command, "_HANDEYE_POSES", 12)  # 30 take two thirds of a run
    monkeypatch.setattr(motion_file, "_REST_S", 0.8)
    monkeypatch.setattr(run_calibrate, "SWEEP_S", 2.0)
    monkeypatch.setattr("armsight.loop.identify.validate.MANY", 0)  # one part of the poses is left out, not five
    run = [command for block in blocks(page) if block.how != "no" for command in block.commands]
    assert any(command.startswith("armsight ") for command in run)
    folder = runner.run(page)
    if page == "tutorials/iso9283_test":
        assert_run_as_devices_are(folder / "run", runner.folder / "shared" / "demo")
    for short, file in pictures(page):
        assert short == folder.name
        assert (folder / file).stat().st_size > 5000, file  # an empty plot of this size would be smaller
