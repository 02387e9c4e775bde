"""What every command that writes holds to: inputs stay, two outputs are two files, and what cannot be written ends at once.

No input here can be read: a command that reads one before it looks at its output fails with another message.
"""

import os

import click
import pytest

from armsight.app.main import COMMANDS, group
from armsight.app.options import kept
from cli_runs import assert_rejected
from strategies import ordinary_rig

#: Command -> arguments without its output. ``board build`` compiles first what it is to write; ``run`` needs its rig first.
FILE_WRITERS = {
    "rig import": ("f.yml", "--format", "opencv"),
    "rig export": ("rig.json", "--format", "kalibr"),
    "calibrate": ("--source", "pairs:left*.png,right*.png", "--target", "chessboard:9x6:25mm"),
    "measure": ("rig.json", "--target", "chessboard:9x6:25mm", "--source", "pairs:left*.png,right*.png"),
    "body draw": ("body.toml",),
    "arm show": ("arm.toml",),
    "arm urdf": ("arm.toml",),
    "check plan": ("--arm", "arm.toml"),
    "identify plan": ("--arm", "six_r"),
    "arm calibrated": ("six_r", "arm.toml"),
    "arm plan": ("six_r", "--around", "run"),
    "rig update": (".",),
    "references calibrate": ("arm.toml", "--poses", "poses.csv"),
}
FOLDER_WRITERS = {
    "calibrate --report": (*FILE_WRITERS["calibrate"], "-o", "new.json"),
    "measure --view": FILE_WRITERS["measure"],
    "dense match": ("rig.json", "left1.png", "right1.png"),
    "dense evaluate": (".",),
    "check": ("poses.csv",),
    "arm report": (".",),
    "board bringup": ("--board", "serial:/dev/none"),
    "record": ("usb:97,98",),
    "demo": ("--arm", "no such arm"),
    "handeye": ("--robot", "poses.csv", "--eye", "in-hand", "--seen", "seen.csv"),
    "replay": (".",),
    "export": (".", "--to", "csv"),
    "batch": ("measure", "f.yml"),
    "budget": ("arm.toml",),
    "hub": ("--listen", "nonsense"),
    "hub keys": ("my lab",),
}
SUFFIXES = {
    "arm show": ".png",
    "arm urdf": ".urdf",
    "check plan": ".toml",
    "identify plan": ".csv",
    "arm calibrated": ".urdf",
    "arm plan": ".toml",
    "body draw": ".pdf",
}
ELSEWHERE = {"identify", "live", "run", "board config get", "board build", "board flash"}


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in a folder of files that all are nonsense but the rig."""
    monkeypatch.chdir(tmp_path)
    for name in ("left1.png", "right1.png", "left2.png", "right2.png", "f.yml", "body.toml", "arm.toml", "poses.csv"):
        (tmp_path / name).write_text("nonsense\n")
    ordinary_rig().save(tmp_path / "rig.json")
    return tmp_path


def writers(command, name=""):
    """Yield the names of all commands that have an option -o."""
    if any("-o" in parameter.opts for parameter in command.params):
        yield name
    if isinstance(command, click.Group):
        for each in command.list_commands(click.Context(command)):
            yield from writers(command.get_command(click.Context(command), each), f"{name} {each}".strip())


def test_every_command_that_writes_is_tried_here():
    assert set(COMMANDS) <= set(group.list_commands(click.Context(group)))
    known = {name.split(" --")[0] for name in (*FILE_WRITERS, *FOLDER_WRITERS)} | ELSEWHERE
    assert {name.removesuffix(" evaluate") if name == "check evaluate" else name for name in writers(group)} == known


def call(armsight, name, arguments, output):
    words, option, _ = name.partition(" --")
    return armsight(*words.split(), *arguments, f"--{_}" if option else "-o", output)


@pytest.mark.parametrize("name", [*FILE_WRITERS, *FOLDER_WRITERS])
def test_what_cannot_be_written_is_reported_at_once(here, armsight, name):
    before, end = sorted(os.listdir(here)), SUFFIXES.get(name, "")
    of_files = (
        (f"none/out{end}", ["cannot be written", "there is no folder"]),
        (f"/proc/out{end}", [f"/proc/out{end}", "cannot be written"]),
        (f"{'x' * 250}{end}", ["cannot be written", "File name too long"]),
        *([] if end else [(".", ["it is a folder"]), ("-", ["-: give the name of a file"])]),
    )
    of_folders = (
        ("rig.json", ["rig.json: no", "Not a directory"]),
        ("rig.json/deeper", ["rig.json/deeper: no", "here"]),
        ("/proc/out", ["/proc/out: no", " here: No such file"]),
        ("x" * 256, ["File name too long"]),
        ("-", ["-: give the name of a file or folder"]),
    )
    for output, words in of_files if name in FILE_WRITERS else of_folders:
        assert_rejected(call(armsight, name, (FILE_WRITERS | FOLDER_WRITERS)[name], output), *words)
    assert sorted(os.listdir(here)) == before


@pytest.mark.parametrize(
    "name", [name for name in FOLDER_WRITERS if name not in ("measure --view", "batch")]
)  # the first draws what was missed, the second has a row for what failed
def test_a_command_that_fails_leaves_no_empty_folder(here, armsight, name):
    before = sorted(os.listdir(here))
    assert call(armsight, name, FOLDER_WRITERS[name], "new/folder").code == 2
    assert sorted(os.listdir(here)) == before


@pytest.mark.parametrize(
    ("arguments", "file"),
    [
        (("rig", "export", "rig.json", "--format", "kalibr", "-o", "rig.json"), "rig.json"),
        (("rig", "export", "rig.json", "--format", "ros", "-o", "a.yaml", "link.json"), "rig.json"),
        (("rig", "import", "f.yml", "--format", "opencv", "-o", "f.yml"), "f.yml"),
        (("calibrate", *FILE_WRITERS["calibrate"], "-o", "right2.png"), "right2.png"),
        (("measure", *FILE_WRITERS["measure"], "-o", "left1.png"), "left1.png"),
        (("measure", "rig.json", "--target", "chessboard:9x6:25mm", "--source", ".", "-o", "right1.png"), "right1.png"),
        (("measure", *FILE_WRITERS["measure"], "-o", "rig.json"), "rig.json"),
        (("dense", "rig.json", "pair/left.png", "right1.png", "-o", "pair"), "pair"),
        (("body", "draw", "page.svg", "-o", "page.svg"), "page.svg"),
        (("arm", "urdf", "arm.urdf", "-o", "./arm.urdf"), "arm.urdf"),
        (("check", "plan", "--arm", "arm.toml", "-o", "arm.toml"), "arm.toml"),
    ],
)
def test_no_input_is_written_over(here, armsight, arguments, file):
    os.link(here / "rig.json", here / "link.json")
    (here / "pair").mkdir()
    for name in ("pair/left.png", "page.svg", "arm.urdf"):
        (here / name).write_text("nonsense\n")
    before = {path: path.read_bytes() for path in here.rglob("*.*")}
    assert_rejected(armsight(*arguments), "would be written over")
    assert {path: path.read_bytes() for path in here.rglob("*.*")} == before
    assert (here / file).exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ("rig", "export", "rig.json", "--format", "ros", "-o", "a.yaml", "./a.yaml"),
        ("measure", *FILE_WRITERS["measure"], "-o", "run.png", "--view", "."),
        ("measure", *FILE_WRITERS["measure"], "-o", "one", "--view", "one"),
        ("calibrate", *FILE_WRITERS["calibrate"], "-o", "one", "--report", "one"),
        ("calibrate", *FILE_WRITERS["calibrate"], "-o", "r.json", "--report", ".", "-o", "report.html"),
    ],
)
def test_two_outputs_are_two_files(here, armsight, arguments):
    before = sorted(os.listdir(here))
    assert_rejected(armsight(*arguments), "given twice")
    assert sorted(os.listdir(here)) == before


def test_the_suffix_of_an_arms_files_is_checked(here, armsight):
    assert_rejected(armsight("arm", "show", "six_r", "-o", "a.xyz"), "a.xyz", ".png")
    assert_rejected(armsight("arm", "urdf", "six_r", "-o", "a.png"), "a.png", ".urdf")
    assert_rejected(armsight("arm", "show", "six_r", "-o", "-"), "-: ")


def test_millimetres_taken_for_metres_are_reported(here, armsight):
    said = armsight("dense", "rig.json", "left1.png", "right1.png", "--near", "300", "-o", "out")
    assert_rejected(said, "--near 300", "--near 0.3", "metres")


#: Command -> the titles of its report, those of version 0.2 first.
TITLES = {
    "board bringup": ("Bring-up", "armsight: bring-up", "armsight: board bringup"),
    "calibrate --report": ("armsight: calibration report", "armsight: calibrate"),
    "handeye": ("armsight: hand-eye calibration", "armsight: handeye"),
    "identify": ("armsight: identification of an arm", "armsight: identify"),
    "arm report": ("armsight: A&amp;B", "armsight: arm report"),
    "rig update --report": ("armsight rig update", "armsight: rig update"),
    "check": ("armsight: check",),
    "budget": ("armsight: budget",),
}
REPORTED = FOLDER_WRITERS | {
    "identify": ("--data", "poses.csv", "--arm", "arm.toml"),
    "rig update --report": (".", "-o", "2.json"),
}
RUN = ("--rig", "none.json", "--target", "body.toml", "--source", ".", "--board", "emulated:")


@pytest.mark.parametrize("name", TITLES)
def test_a_report_is_replaced_by_its_own_command_alone_also_one_of_version_0_2(here, armsight, name):
    page = here / "their" / "report.html"
    page.parent.mkdir()
    (page.parent / "report.json").write_text('{"arm": "A&B"}')
    for own, titles in TITLES.items():
        for title in titles:
            page.write_text(f"<title>{title}</title>")
            said = call(armsight, name, REPORTED[name], "their")
            words = f"their: holds a report of {own.partition(' --')[0]}, which would be written over"
            assert said.code == 2, said
            assert (words in said.err) == (own != name), said.err
    page.write_text("<title>Coverage report</title>")
    assert_rejected(call(armsight, name, REPORTED[name], "their"), "holds a report of another program")


@pytest.mark.parametrize("name", [*FOLDER_WRITERS, "run"])
def test_a_run_is_not_written_over_and_a_summary_of_others_keeps_no_other_command_away(here, armsight, name):
    (here / "their").mkdir()
    (here / "their" / "summary.json").write_text("{}")
    said = call(armsight, name, {**FOLDER_WRITERS, "run": RUN}[name], "their")
    assert ("their: holds a report of run" in said.err) == (name in {*TITLES, "replay"}), said.err


@pytest.mark.parametrize(
    ("name", "held"),
    [
        ("budget", ["budget.json", "rig.json", "body.toml"]),
        ("identify", ["corrected.toml", "zeros.toml"]),
        ("handeye", ["handeye.json"]),
        ("demo", ["rig.json", "motion.toml"]),
        ("dense match", ["left.png"]),
        ("replay", ["poses.csv"]),
        ("arm report", ["report.json"]),
        ("board bringup", ["board.toml"]),
    ],
)
def test_a_folder_of_ones_own_files_is_left_alone(here, armsight, name, held):
    (here / "mine").mkdir()
    for each in (*held, "notes.txt"):
        (here / "mine" / each).write_text("mine\n")
    given = {**FOLDER_WRITERS, "identify": ("--arm", "six_r", "--data", "poses.csv"), "budget": ()}[name]
    said = call(armsight, name, given, "mine")
    assert_rejected(said, "mine: holds", ", which would be written over; choose another folder", *held)
    assert "notes" not in said.err
    assert {path.read_text() for path in (here / "mine").iterdir()} == {"mine\n"}


def test_a_folder_is_written_again_with_a_note_until_one_edits_it(here, armsight):
    arguments = ("budget", "volume=0.1x0.1x0.1m", "distance=0.7m", "camera=machine-vision-2mp", "-o", "bud")
    assert armsight(*arguments).code == 0
    assert "replaced" not in (first := armsight(*arguments, "--json")).out
    for each in ("report.html", "budget.json", "rig.json", "body.toml", "body.pdf"):
        assert os.path.join("bud", each) in first.err
    edited = (here / "bud" / "body.toml").read_text() + "# mine\n"
    (here / "bud" / "body.toml").write_text(edited)
    assert_rejected(armsight(*arguments), "bud: holds body.toml,", "changed after report.html was written")
    assert (here / "bud" / "body.toml").read_text() == edited


@pytest.mark.parametrize("name", FILE_WRITERS)
def test_a_file_of_another_kind_is_left_alone(here, armsight, name):
    output = f"mine{SUFFIXES.get(name, '.json')}"
    (here / output).write_text("[other]\nx = 1\n")
    if name != "arm calibrated":  # which keeps the file
        said = call(armsight, name, FILE_WRITERS[name], output)
        assert_rejected(said, f"{output}: holds something else, which would be written over")
    assert (here / output).read_text() == "[other]\nx = 1\n"


def test_a_file_beside_a_new_folder_is_none_of_its(here):
    context = click.Context(click.Command("budget"))
    (here / "out.txt").write_text("of the shell\n")
    kept(context, click.Option(["-o"]), "out", report=True)
    assert context.meta["before"] == {}
    kept(context, click.Option(["-o"]), "out.json")
    assert list(context.meta["before"]) == ["out.txt"]


def test_files_of_the_same_kind_are_replaced_and_named(here, armsight):
    arguments = ("rig", "export", "rig.json", "--format", "ros", "-o", "l.yaml", "r.yaml")
    assert "replaced" not in armsight(*arguments).err
    assert "note: replaced: l.yaml, r.yaml\n" in armsight(*arguments).err
