"""``armsight check`` on a run's folder, made here with a known arm and a known instrument."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from armsight.app.check.evaluate import evaluate, read_check
from armsight.app.check.report import paths_figure
from armsight.app.check.rows import read_rows
from armsight.app.check.run_folder import _reversal_times, attained_in, joint_track, reversals_of, segments_of
from armsight.errors import InputError
from cli_runs import assert_rejected, said_of

NOISE_M, COMMON_M, ARM_M = 4e-5, 2e-4, 1e-4
OFF_M = np.array([1.5e-3, -8e-4, 4e-4])
POSITIONS = {
    "P1": (0.5, 0.0, 0.4),
    "P2": (0.6, -0.1, 0.5),
    "P3": (0.6, 0.1, 0.5),
    "P4": (0.4, 0.1, 0.3),
    "P5": (0.4, -0.1, 0.3),
}
COLUMNS = ["t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]
SIGMAS = ["sigma_x_m", "sigma_y_m", "sigma_z_m"]
CENTRE, RADIUS, BACKLASH = np.array([0.5, 0.0, 0.4]), 0.08, 3e-4


class Folder:
    """A run's folder in the making: the tool is commanded 100 times a second, and seen 50 times."""

    def __init__(self, folder, seed=0):
        self.folder, self.rng, self.t = folder, np.random.default_rng(seed), 0.0
        self.common = self.rng.normal(0, COMMON_M, 3)
        self.reference, self.seen, self.motions = [], [], []

    def segment(self, phase, name, positions, off, *, hidden=False):
        for k, (position, away) in enumerate(zip(positions, off, strict=True)):
            self.t += 0.01
            self.reference.append([self.t, *position, 1, 0, 0, 0, phase, name])
            if k % 2 == 1 and not hidden:
                at = position + away + self.common + self.rng.normal(0, NOISE_M, 3)
                claimed = [np.hypot(NOISE_M, COMMON_M)] * 3
                self.seen.append([self.t - 0.001, *at, 1, 0, 0, 0, *claimed, phase, name])

    def motion(self, phase, name, kind, path, off, **options):
        """A motion along a path with offsets, and the rest at its end."""
        if phase == "open_loop":
            self.motions.append((kind, name))
        self.segment(phase, name, path, off)
        self.segment("rest", name, np.repeat(path[-1:], 50, axis=0), np.repeat(off[-1:], 50, axis=0), **options)

    def poses(self, phase, cycles, off=OFF_M, hidden=()):
        before = np.array(POSITIONS["P3"])
        for name, cycle in [("P5", 0)] + [(name, c + 1) for c in range(cycles) for name in POSITIONS]:
            there = np.array(POSITIONS[name])
            path = before + np.linspace(0, 1, 40)[:, None] * (there - before)
            away = np.repeat((off + self.rng.normal(0, ARM_M, 3))[None], 40, axis=0)
            called = f"{name} cycle {cycle}" if cycle else f"to {name}"
            self.motion(phase, called, "joints", path, away, hidden=called in hidden)
            before = there

    def write(self):
        for name, header, rows in (
            ("reference.csv", [*COLUMNS, "phase", "motion"], self.reference),
            ("vision.csv", [*COLUMNS, *SIGMAS, "phase", "motion"], self.seen),
        ):
            with open(self.folder / name, "w", newline="") as file:
                csv.writer(file).writerows([header, *rows])
        text = "".join(f'[[motion]]\nkind = "{kind}"\nname = "{name}"\n' for kind, name in self.motions)
        (self.folder / "motion.toml").write_text(text)
        return self.folder


def said(capsys, *arguments):
    return said_of(capsys, "check", *arguments)


def test_rests_belong_to_their_poses_and_cycles(tmp_path, capsys):
    made = Folder(tmp_path)
    made.segment("calibration", "hand-eye 1", np.zeros((40, 3)), np.zeros((40, 3)))
    made.poses("open_loop", 30, hidden=("P2 cycle 7",))
    made.poses("closed_loop", 5, off=np.zeros(3))
    answer = said(capsys, made.write(), "--json", "-o", tmp_path / "report")
    (found,) = answer.lines
    assert {name: p["count"] for name, p in found["poses"].items()} == {
        "P1": 30,
        "P2": 29,
        "P3": 30,
        "P4": 30,
        "P5": 30,
    }
    assert found["notes"] == [
        "1 rests were not seen, and are left out",
        "left out: P5 approached from the start, too seldom (1)",
    ]
    unit = 3 * np.sqrt(3 - 8 / np.pi) + np.sqrt(8 / np.pi)  # E l + 3 sd l of a normal vector, known in closed form
    held = [p["RP_m"]["low"] < unit * ARM_M < p["RP_m"]["high"] for p in found["poses"].values()]
    assert sum(held) >= 4
    true = np.linalg.norm(OFF_M)
    for p in found["poses"].values():
        assert p["AP_m"]["low"] < true < p["AP_m"]["high"]
        assert (
            0.8 * COMMON_M < p["AP_m"]["sigma"] < 1.2 * np.hypot(COMMON_M, ARM_M)
        )  # what is common is not averaged out
        assert p["RP_m"]["raw"] == pytest.approx(p["RP_m"]["clean"], rel=0.02)  # of 15 shots' mean little is noise
    assert found["distance"] | {"AD_m": 0, "RD_m": 0} == {
        "from": "P2", "to": "P4", "commanded_m": pytest.approx(np.sqrt(0.12)), "AD_m": 0, "RD_m": 0
    }  # fmt: skip
    assert found["drift"]["pose"] == "P1"
    with open(tmp_path / "report" / "check.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["cycle"] for row in rows if row["pose"] == "P2"] == [str(c) for c in range(1, 31) if c != 7]
    noise = np.array([float(row["sigma_x_m"]) for row in rows])
    np.testing.assert_allclose(noise, NOISE_M / np.sqrt(15), rtol=0.1)
    closed = said(capsys, tmp_path, "--closed", "--json").lines[0]
    assert all(p["count"] == 5 for p in closed["poses"].values())
    assert closed["poses"]["P1"]["AP_m"]["raw"] < 0.5 * true
    assert said(capsys, tmp_path / "report", "--json").code == 0  # its check.csv
    (tmp_path / "summary.json").write_text("{}")
    assert_rejected(said(capsys, tmp_path, "-o", tmp_path), "holds a report of run", "another folder")
    assert_rejected(
        said(capsys, tmp_path / "report", "-o", tmp_path / "report"), "check.csv", "is read, and would be written over"
    )


def test_a_repeatability_below_the_noise(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(globals(), "ARM_M", 1e-6)
    made = Folder(tmp_path)
    made.poses("open_loop", 10)
    answer = said(capsys, made.write(), "--json")
    resolved = [p["RP_m"]["clean"] for p in answer.lines[0]["poses"].values()]
    assert sum(clean is None for clean in resolved) >= 4  # 2.5 % each by chance


def line(made, phase, cycles):
    """There and back: 0.5 mm off at the middle, and late by 3 mm, which is no error of a path."""
    s = np.linspace(0, 1, 200)
    for cycle in range(1, cycles + 1):
        for name, share in (("out", s), ("back", s[::-1])):
            path = np.stack([0.4 + 0.2 * share, 0 * s, 0.4 + 0 * s], axis=1)
            late = -3e-3 * np.sign(share[1] - share[0]) * np.sin(np.pi * s)
            off = np.stack([late, 5e-4 * np.sin(np.pi * share), 0 * s], axis=1)
            made.motion(phase, f"{name} cycle {cycle}", "line", path, off)


def circle(made, phase, radius=RADIUS, names=("ccw", "cw")):
    """Both ways with a sixth more than a revolution, backlash along y."""
    a = np.radians(np.linspace(15, 435, 1000))
    for name, angle in zip(names, (a, a[::-1]), strict=True):
        path = CENTRE + radius * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
        way = np.sign(angle[1] - angle[0])
        off = np.stack([0 * a, -0.5 * BACKLASH * np.sign(-way * np.sin(angle)), 0 * a], axis=1)
        made.motion(phase, f"{name} cycle 1", "circle", path, off)


def test_paths_and_the_circle(tmp_path, capsys):
    made = Folder(tmp_path)
    line(made, "open_loop", 4)
    circle(made, "open_loop")
    answer = said(capsys, made.write(), "--json", "-o", tmp_path / "report")
    (found,) = answer.lines
    assert "poses" not in found
    assert set(found["paths"]) == {"out", "back"}
    bow = np.array([0.0, 5e-4, 0.0]) + made.common * [0, 1, 1]
    for p in found["paths"].values():
        assert p["count"] == 4
        assert p["AT_m"]["raw"] == pytest.approx(np.linalg.norm(bow), abs=4 * NOISE_M)
        assert p["AT_m"]["low"] < 5e-4 < p["AT_m"]["high"]
        assert p["RT_m"]["clean"] is None or p["RT_m"]["low"] < 2 * NOISE_M  # all of it is the instrument's
    c = found["circle"]
    assert c["radius_m"] == pytest.approx(RADIUS, abs=2e-5)
    np.testing.assert_allclose(c["axes"], [[0, 1, 0], [0, 0, 1]], atol=1e-9)
    backlash, none = c["backlash_m"]
    assert backlash["low"] < BACKLASH < backlash["high"]
    assert backlash["clean"] is not None
    assert none["clean"] is None
    assert (tmp_path / "report" / "check-circle.png").exists()
    assert said(capsys, tmp_path / "report" / "check.csv", "--json").lines[0]["circle"]["radius_m"] == pytest.approx(
        c["radius_m"], abs=1e-8
    )


def lines(made, names, to=(0.6, 0.0, 0.4), unseen=()):
    """Lines between the same ends; of some a part is not seen: seconds of their 2 s."""
    s = np.linspace(0, 1, 200)[:, None]
    for name in names:
        path = np.array([0.4, 0, 0.4]) + s * (np.array(to) - [0.4, 0, 0.4])
        start = made.t
        made.motion("open_loop", name, "line", path, 0 * path + [0, 5e-4, 0])
        for first, last in dict(unseen).get(name, ()):
            made.seen = [row for row in made.seen if not start + first < row[0] <= start + last]


def test_lines_of_any_name(tmp_path, capsys):
    made = Folder(tmp_path)
    lines(made, [f"line {n}" for n in (1, 3, 5, 7)])  # as motions are called that have no name
    answer = said(capsys, made.write(), "--json")
    assert {name: p["count"] for name, p in answer.lines[0]["paths"].items()} == {"line 1": 4}


def test_two_lines_of_one_name_are_two(tmp_path, capsys):
    made = Folder(tmp_path)
    for first in (1, 3, 5):
        lines(made, [f"go cycle {first}"])
        lines(made, [f"go cycle {first + 1}"], to=(0.5, 0.1, 0.4))
    (found,) = said(capsys, made.write(), "--json", "-o", tmp_path / "report").lines
    assert {name: p["count"] for name, p in found["paths"].items()} == {"go": 3, "go cycle 2": 3}
    plotted = (
        paths_figure(
            evaluate(read_check(tmp_path / "report" / "check.csv")), read_rows(tmp_path / "report" / "check.csv")
        )
        .axes[0]
        .lines
    )
    assert len(plotted) == 2 * (1 + 3)  # each mean path, and its own cycles


def test_what_nobody_saw_is_not_made_up(tmp_path, capsys):
    made = Folder(tmp_path)
    unseen = {
        "go cycle 2": [(0.8, 1.2)],
        "go cycle 3": [(0.0, 0.2)],
        "go cycle 4": [(1.8, 2.0)],
        "go cycle 5": [(0.0, 1.9)],
    }
    lines(made, [f"go cycle {n}" for n in range(1, 8)], unseen=unseen)
    (found,) = said(capsys, made.write(), "--json", "-o", tmp_path / "report").lines
    assert found["paths"]["go"]["count"] == 3
    notes = " ".join(found["notes"])
    assert "go cycle 2, not seen over 4" in notes  # 0.4 s of 100 mm/s
    assert "go cycle 3, not seen from its first path point to its last" in notes
    assert "go cycle 4, not seen from its first path point to its last" in notes
    assert "go cycle 5, seen in 5 shots; 10 are needed" in notes
    with open(tmp_path / "report" / "check.csv") as file:
        assert {row["cycle"] for row in csv.DictReader(file) if row["test"] == "path"} == {"1", "5", "6"}


def test_of_two_circles_both_ways_one_is_evaluated(tmp_path, capsys):
    made = Folder(tmp_path)
    circle(made, "open_loop")
    circle(made, "open_loop", radius=0.05, names=("small ccw", "small cw"))
    (found,) = said(capsys, made.write(), "--json").lines
    assert found["circle"]["radius_m"] == pytest.approx(RADIUS, abs=2e-5)
    assert any("small ccw cycle 1, small cw cycle 1" in note for note in found["notes"])


def test_circles_that_differ_are_no_pair(tmp_path, capsys):
    made = Folder(tmp_path)
    circle(made, "open_loop", names=("ccw", "cw"))
    made.motions = [(kind, name) for kind, name in made.motions if name != "cw cycle 1"]
    for track in (made.reference, made.seen):
        track[:] = [row for row in track if row[-1] != "cw cycle 1"]
    lone = Folder(tmp_path, seed=1)
    circle(lone, "open_loop", radius=0.05, names=("no", "small cw"))
    late = made.t
    for mine, other in ((made.reference, lone.reference), (made.seen, lone.seen)):
        mine += [[late + row[0], *row[1:]] for row in other if row[-1] == "small cw cycle 1"]
    made.motions.append(("circle", "small cw cycle 1"))
    assert_rejected(said(capsys, made.write()), "nothing can be evaluated", "ccw, followed too seldom (1)")


def test_visits_are_counted_by_pose_and_ways_over_all_rests(tmp_path, capsys):
    made = Folder(tmp_path)
    made.poses("open_loop", 4)
    lines(made, ["go cycle 1", "go cycle 2", "go cycle 3"])
    made.poses("open_loop", 0)
    (found,) = said(capsys, made.write(), "--json", "-o", tmp_path / "report").lines
    # P5 from the start once, from P4 four times, and after the lines from where they end.
    assert "left out: P5 approached from go, too seldom (1)" in found["notes"]
    with open(tmp_path / "report" / "check.csv") as file:
        rows = [row for row in csv.DictReader(file) if row["pose"] == "P5"]
    assert [row["cycle"] for row in rows] == ["2", "3", "4", "5"]  # the first was from the start


def test_poses_attained_once_are_reported_where_others_are_evaluated(tmp_path, capsys):
    made = Folder(tmp_path)
    made.poses("open_loop", 3)
    there = np.repeat([[0.55, 0.0, 0.35]], 40, axis=0)
    made.motion("open_loop", "aside", "joints", there, 0 * there)
    (found,) = said(capsys, made.write(), "--json").lines
    assert found["notes"].count("left out: aside, attained too seldom (1)") == 1


def test_a_joint_that_stands_where_it_reverses():
    t_s = np.arange(9.0)
    q = np.array([0.0, 0.1, 0.2, 0.2, 0.1, 0.0, 0.0, -0.1, -0.2])
    assert _reversal_times(t_s, q) == [2.0]
    assert _reversal_times(t_s, np.abs(t_s - 4)) == [4.0]
    assert _reversal_times(t_s, 0 * q) == []


def test_where_joints_reverse(tmp_path, capsys):
    made = Folder(tmp_path)
    circle(made, "open_loop")
    spans = [
        [t for t, *_, phase, name in made.reference if name == f"{w} cycle 1" and phase == "open_loop"]
        for w in ("ccw", "cw")
    ]
    made.write()
    with open(tmp_path / "joints.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t_s", *(f"q{joint}_ref_rad" for joint in range(1, 7))])
        for span in spans:
            for t in span:
                a = 15 + 420 * (t - span[0]) / (span[-1] - span[0])
                a = a if span is spans[0] else 450 - a
                # Joint 2 reverses at 0 and 180 degrees, as the backlash does; joint 4 by too little; the others never.
                writer.writerow([t, t, np.cos(np.radians(a)), 0, 1e-3 * np.cos(np.radians(a)), -t, 0])
    found = said(capsys, tmp_path, "--json", "-o", tmp_path / "report").lines[0]
    reversals = found["circle"]["reversals"]
    assert all(reversal["joints"] == [2] for reversal in reversals)
    found = sorted((reversal["way"], round(reversal["angle_deg"] / 180) % 2) for reversal in reversals)
    assert found == [(-1, 0), (-1, 1), (1, 0), (1, 1)]
    for reversal in reversals:
        assert reversal["jump_m"]["raw"] == pytest.approx(BACKLASH, abs=5 * reversal["jump_m"]["sigma"])
        assert reversal["jump_m"]["sigma"] < 5e-5
    assert "joint 2 at 180 deg, counter-clockwise" in said(capsys, tmp_path).out
    (tmp_path / "joints.csv").write_text("t_s\n1\n")
    assert_rejected(said(capsys, tmp_path), "joints.csv", "q1_ref_rad")


def test_folders_that_cannot_be_evaluated(tmp_path, capsys):
    assert_rejected(said(capsys, tmp_path), tmp_path, "no run", "reference.csv")
    made = Folder(tmp_path)
    made.poses("open_loop", 1)
    circle(made, "open_loop")
    line(made, "open_loop", 1)
    whole = made.write()
    answer = said(capsys, whole, "--json")  # one cycle: of the poses nothing, of the circle all
    assert set(answer.lines[0]) == {"circle", "notes", "weak"}
    assert "left out: all poses, as none was attained 3 times" in answer.lines[0]["notes"]
    assert_rejected(said(capsys, whole, "--closed"), "no motions with the loop closed")
    (whole / "motion.toml").write_text("motion = 3")
    assert_rejected(said(capsys, whole), "motion.toml", "not a motion file")
    made = Folder(tmp_path)
    made.poses("open_loop", 1)
    assert_rejected(
        said(capsys, made.write(), "-o", tmp_path / "report"), "5 poses", "no repeatability", "armsight check plan"
    )
    assert not (tmp_path / "report").exists()
    lines = (tmp_path / "vision.csv").read_text().splitlines()
    for bad, parts in (
        (lines[0].replace("sigma_y_m", "sigma_q"), ("line 1", "sigma_y_m")),
        (lines[1].replace(lines[1].split(",")[1], "nan"), ("line 2", "finite")),
        (lines[1].replace(lines[1].split(",")[1], "x"), ("line 2", "numbers")),
        ("0.1,0.2", ("line 2", "numbers")),
    ):
        first = "line 1" in parts
        (tmp_path / "vision.csv").write_text("\n".join([bad, *lines[1:]] if first else [lines[0], bad, *lines[2:]]))
        assert_rejected(said(capsys, tmp_path), "vision.csv", *parts)
    (tmp_path / "vision.csv").write_text("\n".join([*lines[:4], lines[2], *lines[4:]]))
    assert_rejected(said(capsys, tmp_path), "vision.csv", "line 5", "times must rise")
    (tmp_path / "vision.csv").write_text(lines[0] + "\n")
    assert_rejected(said(capsys, tmp_path), "vision.csv", "no rows")
    (tmp_path / "vision.csv").write_text("\n".join(lines[:3]))
    assert_rejected(said(capsys, tmp_path), "hardly seen")


def test_json_has_no_nan(tmp_path, capsys):
    made = Folder(tmp_path)
    made.poses("open_loop", 3)
    found = said(capsys, made.write(), "--json").lines[0]  # read strictly
    assert json.dumps(found, allow_nan=False)


#: A run's folder as version 1 wrote it, cut down: names of files and columns that have changed since.
VERSION_1 = Path(__file__).parent / "written_by_version_1"


def test_a_folder_of_version_1_is_read_as_version_1_read_it():
    attained = attained_in(VERSION_1, closed=False)
    assert [(row.pose, row.cycle, row.approach, row.t_s) for row in attained.rows] == [
        ("line", "1", "pose 1", 26.641),
        ("line", "2", "sides -++-+-", 30.341),
        ("pose 1", "1", "the start", 24.641),
    ]
    expected = [  # as version 1 computed them from this folder
        [0.529576546, -0.14048700416666668, 0.49977340149999994],
        [0.5296098871666667, -0.14036367833333332, 0.49978951099999996],
        [0.4876840593333333, 0.200964638, 0.519729746],
    ]
    np.testing.assert_allclose([row.T[:3, 3] for row in attained.rows], expected, rtol=1e-12)
    assert attained.rows[0].cov[0, 0] == pytest.approx(2.0483213388858718e-11, rel=1e-12)


def test_a_folder_of_a_newer_version_is_rejected(tmp_path):
    shutil.copytree(VERSION_1, tmp_path / "run")
    (tmp_path / "run/summary.json").write_text('{"version": 3}')
    with pytest.raises(InputError, match=r"summary.json: run version 3, this armsight reads up to 2: update armsight"):
        segments_of(tmp_path / "run", closed=False)


def test_the_joints_of_version_1_are_read_as_version_1_read_them():
    circle = [segment for segment in segments_of(VERSION_1, False) if segment.kind == "circle"]
    reversals = reversals_of(joint_track(VERSION_1), circle)
    assert [reversal.joints for reversal in reversals] == [(1, 5), (3,), (2, 4), (1, 5, 6), (3, 4), (2,)]
    np.testing.assert_allclose(reversals[0].p, [0.52770854, -0.14471832, 0.46398389], atol=5e-9)


def test_check_says_of_a_folder_of_version_1_what_it_holds(capsys):
    assert_rejected(
        said(capsys, VERSION_1), "of 2 poses none was attained 3 times, the most 2", "line, seen in 0 shots"
    )


@pytest.mark.parametrize("joints", [True, False])
def test_a_visit_through_a_waypoint_without_rest_is_of_its_own_approach(joints, tmp_path, capsys):
    made, q = Folder(tmp_path), []
    made.rng = np.random.default_rng(2)
    at = {"P1": 0.0, "P2": 0.5, "aside": -0.2}  # a joint's angle, whose backlash moves the tool by 2 mm

    def go(name, frm, to, rest):
        path = np.array([0.5, 0.0, 0.4]) + np.linspace(at[frm], at[to], 40)[:, None] * np.array([0.2, 0.1, 0.0])
        off = np.repeat([[1e-3 * np.sign(at[to] - at[frm]), 0, 0]], 40, axis=0)
        begun = len(made.reference)
        made.motions.append(("joints", name))
        made.segment("open_loop", name, path, off)
        if rest:
            made.segment("rest", name, np.repeat(path[-1:], 50, axis=0), np.repeat(off[-1:], 50, axis=0))
        angle = np.append(np.linspace(at[frm], at[to], 40), np.full(50 * rest, at[to]))
        q.extend([row[0], angle[k], 0.0] for k, row in enumerate(made.reference[begun:]))

    for cycle in range(6):
        go(f"P2 cycle {cycle}", "P1", "P2", rest=True)
        if cycle == 3:
            go("aside", "P2", "aside", rest=False)
            go("P1 from the other side", "aside", "P1", rest=True)
        else:
            go(f"P1 cycle {cycle}", "P2", "P1", rest=True)
    made.write()
    if joints:
        np.savetxt(tmp_path / "joints.csv", q, "%.6f", ",", header="t_s,q1_ref_rad,q2_ref_rad", comments="")
    (found,) = said(capsys, tmp_path, "--json").lines
    assert found["poses"]["P1"]["RP_m"]["raw"] < 1e-4  # three times the noise; 2 mm with both sides
    came = "smaller angles of joint 1" if joints else "aside"
    assert f"left out: P1 approached from {came}, too seldom (1)" in found["notes"]
