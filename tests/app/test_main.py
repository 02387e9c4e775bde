"""The command line as a whole: its own errors, its version, what it needs, its colours."""

import importlib.metadata
import io
import json
import os
import pty
import subprocess
import sys

import click
import pytest

import armsight as package
from armsight.app.main import COMMANDS, SECTIONS, group
from cli_runs import assert_has, assert_rejected
from strategies import ordinary_rig


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nothing",), ["no such command 'nothing'", "armsight -h"]),
        (("calibrte",), ["no such command 'calibrte': did you mean calibrate?"]),
        (("hub", "nothere"), ["no such command 'nothere'; known are clocks, hold, keys, push"]),
        (("rig", "poses.png"), ["no such command 'poses.png'; known are export, import, show, update"]),
        (("arm", "shw", "ur3"), ["no such command 'shw': did you mean show?", "armsight arm -h"]),
        (("arm", "show", "ur33"), ["arm 'ur33' is unknown: did you mean ur3", "known are"]),
        (("identify", "poses.csv"), ["no such command 'poses.csv': a file follows an option, --data poses.csv"]),
        (("demo", "--seed", "abc"), ["'abc' is not a whole number", "armsight demo -h"]),
        (("--nothing",), ["no such option", "--nothing"]),
        (("measure", "--nothing"), ["no such option", "armsight measure -h"]),
        (("measure", "--sorce", "a"), ["no such option: --sorce: did you mean --source?", "armsight measure -h"]),
        (("run", "--model", "ur3e"), ["no such option: --model: did you mean --arm?", "armsight run -h"]),
        (("demo", "--rigg", "r.json"), ["no such option: --rigg; the usage is in: armsight demo -h"]),
        (("measure",), ["RIG.json", "armsight measure -h"]),
        (("live", "images"), ["argument (images): images follow an option, --source images", "armsight live -h"]),
        (
            ("calibrate", "-o", "r", "--target", "b", "--source", "a1.png", "a2.png", "a3.png"),
            ["(a2.png a3.png); quote a glob, --source 'pairs:DIR/"],
        ),
        (
            ("calibrate", "-o", "r", "--target", "b", "--source", "pairs:a1,b1", "a2", "b2"),
            ["quote a glob, --source 'pairs:DIR/"],
        ),
        (
            ("measure", "r.json", "--target", "b", "--source", "im1.png", "im2.png"),
            ["quote a glob, --source 'pairs:DIR/"],
        ),
        (("rig", "export", "r.json", "-o", "a"), ["--format", "opencv, ros, kalibr", "armsight rig export -h"]),
        (("check", "plan"), ["--arm", "armsight check plan -h"]),
        (("check",), ["RUN|POSES.csv", "armsight check -h"]),
        (("dense", "a", "b", "c", "--method", "x", "-o", "d"), ["'x' is not one of", "armsight dense match -h"]),
        (("demo", "--board", "real"), ["--board real", "emulated:unicorn", "armsight demo -h"]),
    ],
)
def test_a_mistake_on_the_command_line_is_one_line(armsight, arguments, words):
    assert_rejected(armsight(*arguments), *words)


def test_the_package_runs_and_has_a_version():
    version = importlib.metadata.version("armsight")
    assert package.__version__ == version
    ran = subprocess.run([sys.executable, "-m", "armsight", "--version"], capture_output=True, text=True, check=True)
    assert ran.stdout == f"armsight, version {version}\n"
    ran = subprocess.run([sys.executable, "-m", "armsight", "nothing"], capture_output=True, text=True, check=False)
    assert ran.returncode == 2
    assert ran.stderr.startswith("armsight: error: no such command")


def test_a_reader_that_closed_is_no_error():
    reader, writer = os.pipe()
    os.close(reader)
    ran = subprocess.run(
        [sys.executable, "-m", "armsight", "arm", "list"], stdout=writer, stderr=subprocess.PIPE, check=False
    )
    os.close(writer)
    assert (ran.returncode, ran.stderr) == (0, b"")


def stderr_of(arguments, **environment):
    """Return what a run prints on stderr where that is a terminal."""
    ours, theirs = pty.openpty()
    kept = {name: value for name, value in os.environ.items() if name != "NO_COLOR"}
    run = [sys.executable, "-m", "armsight", *arguments]
    subprocess.run(run, stderr=theirs, stdout=subprocess.DEVNULL, env={**kept, **environment}, check=False)
    os.close(theirs)
    said = os.read(ours, 10_000).decode()
    os.close(ours)
    return said


def test_errors_are_red_on_a_terminal_without_no_color():
    assert stderr_of(["nothing"]).startswith("\x1b[31marmsight: error: no such command")
    assert stderr_of(["nothing"], NO_COLOR="1").startswith("armsight: error: no such command")
    assert stderr_of(["rig", "show", "none.json"]).startswith("\x1b[31marmsight: error: none.json: no such file")


@pytest.mark.parametrize(
    ("module", "arguments", "extra"),
    [
        ("mujoco", ("demo", "--quick"), "sim"),
        ("matplotlib", ("demo",), "sim"),
        ("matplotlib.figure", ("check", "a.csv", "-o", "a"), "report"),
        ("matplotlib.figure", ("arm", "show", "six_r", "-o", "a.png"), "report"),
        ("pyarrow", ("demo",), "sim"),
        ("serial", ("board", "monitor", "--board", "serial:/dev/none"), "board"),
        ("unicorn", ("board", "monitor", "--board", "emulated:unicorn"), "sim"),
        ("distributed", ("batch", "measure", "*.bag", "-o", "out"), "batch"),
    ],
)
def test_an_optional_package_that_is_missing_is_named(armsight, monkeypatch, tmp_path, module, arguments, extra):
    monkeypatch.chdir(tmp_path)
    ordinary_rig("brown4").save("rig.json")
    monkeypatch.setitem(sys.modules, module, None)
    said = armsight(*arguments)
    assert_rejected(said, "pip install", f"armsight[{extra}]")
    assert os.listdir(tmp_path) == ["rig.json"]


def test_an_optional_package_that_is_broken_is_named(armsight, monkeypatch, tmp_path):
    (tmp_path / "mujoco.py").write_text("raise OSError('libGL.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mujoco", raising=False)
    said = armsight("demo", "--quick")
    assert_rejected(said, "mujoco, which is installed and cannot be imported: libGL.so.1: cannot open")


def test_help_needs_no_optional_package():
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('mujoco', 'matplotlib', 'pyarrow', 'serial', 'unicorn', 'yaml')))\n"
        "from armsight.app.main import main; main()"
    )
    ran = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True, check=True)
    assert all(f"  {name} " in ran.stdout for name in COMMANDS)


#: Asks every command for its help and makes a mistake in its options; prints as JSON which slow packages each imported.
LIGHT = """
import contextlib, io, json, sys
import click
from armsight.app.main import group
from armsight.errors import ArmsightError

heavy = {"numpy", "cv2", "scipy", "matplotlib"}
found = {}

def ask(*words):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(click.exceptions.Exit):
        try:
            group.main(words, prog_name="armsight", standalone_mode=False)
        except (click.UsageError, ArmsightError):
            pass
    found[" ".join(words)] = sorted(heavy & set(sys.modules))
    heavy.difference_update(sys.modules)

def walk(command, *words):
    ask(*words, "-h")
    if not command.context_settings.get("ignore_unknown_options"):  # of arm fk, which takes negative numbers
        ask(*words, "--nothing")
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            walk(command.get_command(context, name), *words, name)

walk(group)
ask("demo", "--board", "real")
ask("measure", "rig.json", "--target", "chessboard:9x6:25mm")
print(json.dumps(found))
"""


def test_no_help_and_no_mistake_in_options_imports_what_is_slow():
    ran = subprocess.run([sys.executable, "-c", LIGHT], capture_output=True, text=True, check=True)
    found = json.loads(ran.stdout)
    assert len(found) > 2 * len(COMMANDS)
    assert {words: names for words, names in found.items() if names} == {}


def test_help_says_what_identify_needs_and_lists_measure_first(armsight):
    text = " ".join(armsight("identify", "--help").out.split())
    assert_has(text, "--arm ARM Required: the nominal arm", "--data POSES.csv Required: joint angles")
    text = armsight("-h").out
    assert text.index("\n  measure ") < text.index("\n  body ") < text.index("\n  dense ")
    # --help: click keeps a command's help option as it was made first, and other tests make it without -h.
    assert "OUT are the format's files in the order" in " ".join(armsight("rig", "export", "--help").out.split())


def test_the_list_of_commands_has_the_first_sentences_of_their_help():
    context = click.Context(group)
    for names in SECTIONS.values():
        for name, text in names.items():
            assert group.get_command(context, name).get_short_help_str(1000) == text


def test_a_glob_that_the_shell_expanded_is_said_with_retired_options_too(armsight):
    said = armsight("calibrate", "-o", "r", "--target", "b", "--left", "a1", "a2", "--right", "b1", "b2")
    assert said.code == 2
    assert "quote a glob" in said.err


def test_a_question_to_a_closed_standard_input_is_one_line(tmp_path, armsight, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    (tmp_path / "arm.urdf").write_text("kept")
    said = armsight("arm", "calibrated", "ur5", "ur5", "-o", tmp_path / "arm.urdf")
    assert said.code == 2
    assert "nobody answers, as the standard input is closed" in said.err
    assert (tmp_path / "arm.urdf").read_text() == "kept"


@pytest.mark.parametrize("raising", ["raise KeyboardInterrupt", "exec('raise KeyboardInterrupt')"])
def test_an_interrupt_while_it_is_imported_is_said_in_one_line(tmp_path, raising):
    """Also one within exec: CPython 3.11 ends by the signal then, though it is caught."""
    code = (
        "import runpy, sys\n"
        "class Interrupts:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'armsight.app.main':\n"
        f"            {raising}\n"
        "sys.meta_path.insert(0, Interrupts())\n"
        "runpy.run_module('armsight', run_name='__main__')\n"
    )
    (tmp_path / "interrupted.py").write_text(code)
    given = [sys.executable, "-m", "interrupted"]
    done = subprocess.run(given, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "armsight: interrupted\n")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["measure", "body.toml", "--source", "shots", "--target", "body.toml"],
            "body.toml is a body file, which --target",
        ),
        (
            ["measure", "--json", "poses.csv", "--source=x", "--target=b.toml"],
            "poses.csv is a table, which --data, --robot and --seen",
        ),
        (["identify", "--arm", "so101", "--data=rig.json"], "rig.json is a rig, which --rig, armsight measure and"),
        (["identify", "--arm", "body.toml", "--data", "poses.csv"], "body.toml is a body file, which --target"),
        (["serve", "rig.json"], "rig.json is a rig"),
        (["serve", "poses.csv"], "poses.csv is a table"),
        (["serve", "motion.toml"], "motion.toml is a motion file, which --motion and --volume take"),
        (["check", "shots"], "shots is a folder of images, which --source, armsight record and"),
        (
            ["measure", "run", "--source", "shots", "--target", "b.toml"],
            "run is a run's folder, which armsight check, armsight replay and",
        ),
        (
            ["measure", "a.png", "--source", "shots", "--target", "b.toml"],
            "a.png is an image, which --source and armsight dense take",
        ),
        (["board", "monitor", "--board", "feetech:/dev/none,rig.json"], "rig.json is a rig"),
        (["identify", "--arm", "so101", "--data", "so101.urdf"], "so101.urdf is an arm's model (URDF), which --arm"),
    ],
)
def test_a_file_of_another_kind_is_named_with_who_takes_it(armsight, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    for folder, file in (("shots", "left0.png"), ("run", "run.mcap")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / file).write_bytes(b"")
    (tmp_path / "rig.json").write_text('{\n "format": "armsight-rig",\n "version": 1\n}')
    (tmp_path / "body.toml").write_text('# a plate\nversion = 2\n\n[[markers]]\nname = "A"\n')
    (tmp_path / "motion.toml").write_text('[[motion]]\nkind = "joints"\n')
    (tmp_path / "poses.csv").write_text("x_m,y_m,z_m\n1,2,3\n")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0")
    (tmp_path / "so101.urdf").write_text('<?xml version="1.0"?>\n<!-- an arm -->\n<robot name="a"/>')
    answer = armsight(*arguments)
    assert answer.code == 2
    assert said in answer.err
    assert len(answer.err.splitlines()) == 1


def test_a_file_of_the_right_kind_that_is_damaged_is_not_said_to_be_another(armsight, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.json").write_text('{"format": "armsight-rig", "version": 1}')
    (tmp_path / "poses.csv").write_text("q1_deg,x_m\n1,2\n")
    for arguments in (
        ["measure", "--json", "rig.json", "--source", "x"],
        ["identify", "--arm", "so101", "--data", "poses.csv"],
    ):
        answer = armsight(*arguments)
        assert answer.code == 2
        assert " which " not in answer.err


def test_a_file_that_a_command_may_take_or_of_no_known_kind_is_not_said_to_be_another(armsight, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "k.yaml").write_text("# Kalibr, two cameras\ncam0: x, y\n")
    (tmp_path / "svc.toml").write_text('# a service, for the cell\n[mesure]\nrig = "r.json"\n')
    (tmp_path / "wide.toml").write_text(",".join("a" * 40) + " = 1\n")  # a pattern that tries all ways would not end
    (tmp_path / "board.toml").write_text('board = "chessboard:9x6:20mm"\n')
    (tmp_path / "d.csv").write_text("x_m,y_m\n1,2\n")
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "run.mcap").write_bytes(b"")
    (tmp_path / "rec" / "shots.csv").write_text("x,y\n1,2\n")
    for arguments in (
        ["rig", "import", "k.yaml", "-o", "rig.json"],
        ["rig", "import", "d.csv", "-o", "rig.json"],
        ["serve", "svc.toml"],
        ["serve", "wide.toml"],
        ["record", "folder:rec", "-o", "new"],
        ["board", "config", "set", "board.toml"],
        ["arm", "plan", "so101", "--around", "d.csv"],
    ):
        answer = armsight(*arguments)
        assert answer.code == 2, answer.err
        assert " which " not in answer.err


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes")
def test_a_pipe_in_an_error_is_not_opened(tmp_path):
    os.mkfifo(pipe := tmp_path / "pipe")
    command = [sys.executable, "-m", "armsight", "board", "clear", "--board", str(pipe)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 2
    assert str(pipe) in done.stderr
