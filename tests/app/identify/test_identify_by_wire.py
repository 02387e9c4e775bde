"""``armsight identify --references``: an arm by the range to one anchor."""

import json
from dataclasses import replace

import numpy as np
import pytest
from arms import FOUR
from identify_files import arm_toml

from cli_runs import assert_rejected, said_of

ROWS = 80
HOOKED = np.arange(30, 36)


@pytest.fixture(autouse=True)
def one_part(monkeypatch):
    """Leave one part of the poses out, as of many: that of few each is left out once, test_identify_command shows."""
    monkeypatch.setattr("armsight.loop.identify.validate.MANY", 0)


def files(folder, *, timed, off_m=0.0, noise_m=1e-3):
    """Write a nominal arm, the joints at rests of one with a longer link, and a wire's recording; return arguments."""
    rng, nominal = np.random.default_rng(5), replace(FOUR, name="four")
    true = replace(nominal, a=nominal.a + 4e-3 * np.eye(nominal.joints)[1])
    q, t_s = rng.uniform(-1.0, 1.0, (ROWS, nominal.joints)), 2.0 * np.arange(ROWS)
    T = true.forward(q)
    length = np.linalg.norm(T[:, :3, 3] + T[:, :3, :3] @ [0.01, 0.02, 0.05] - [0.4, -0.6, -0.1], axis=1)
    length += off_m * np.sin(4.0 * q[:, 0]) * np.sin(3.0 * q[:, 1])  # no arm does that
    length[HOOKED] += 0.02
    names = ["t_s"] * timed + [f"q{k + 1}_rad" for k in range(nominal.joints)]
    table = np.column_stack([t_s, q] if timed else [q])
    np.savetxt(folder / "joints.csv", table, "%.7f", ",", header=",".join(names), comments="")
    late, wire = 0.04, np.column_stack([length + rng.normal(0.0, 1e-4, ROWS)])
    if timed:
        at = (t_s[:, None] + np.arange(-0.1, 0.11, 0.05)).ravel()
        wire = np.column_stack([at + late, np.repeat(length, 5) + rng.normal(0.0, 1e-4, len(at))])
    wire[:, -1] *= 1e3
    np.savetxt(folder / "wire.csv", wire, "%.6f", ",", header="t_s,range_mm" if timed else "range_mm", comments="")
    text = f'[wire]\nkind = "range"\nsource = "wire.csv"\ndelay_s = {late}\nnoise_m = {noise_m}\n'
    (folder / "references.toml").write_text(text)
    arm = arm_toml(folder / "four.toml", nominal)
    return "--arm", str(arm), "--data", str(folder / "joints.csv"), "--references", str(folder / "references.toml")


def with_positions(folder, names, numbers):
    """Add columns to the joints, and take all out of row 10."""
    head, *rows = (folder / "joints.csv").read_text().splitlines()
    rows = [f"{row},{numbers}" for row in rows]
    rows[9] = "," * rows[9].count(",")
    (folder / "joints.csv").write_text("\n".join([f"{head},{names}", *rows]) + "\n")


def test_one_wire_finds_a_longer_link_and_its_hooks(tmp_path, capsys):
    for timed in (False, True):
        given = files(tmp_path, timed=timed)
        if not timed:
            with_positions(tmp_path, "x_cm,y_cm,z_cm", "1,2,3")
        found = said_of(capsys, "identify", *given, "--json", *([] if timed else ["-o", tmp_path / "out"])).one
        before, after = (found[key]["mean_m"] for key in ("nominal", "identified"))
        assert after < 0.5 * before, timed
        a2 = next(each for each in found["parameters"] if each["name"] == "a2")
        assert abs(a2["value"] - FOUR.a[1] - 4e-3) < 4 * a2["sigma"], timed
        assert found["poses"] == ROWS - len(HOOKED) - (not timed), timed
        assert ("columns not used: x_cm, y_cm, z_cm" in json.dumps(found)) is not timed
        assert "lines 32 to 37: the wire reads" in json.dumps(found), timed  # line 1 has the names
    assert (tmp_path / "out" / "corrected.toml").exists()
    assert "Usable for the wire" in (tmp_path / "out" / "report.html").read_text()
    assert not (tmp_path / "out" / "zeros.toml").exists()  # one wire shows no zero alone


def test_a_residual_far_above_the_ranges_noise_is_not_usable_and_no_change_is_asserted(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "armsight.app.identify.run._notes", lambda *_: ["from line 9 on the poses are of another state"]
    )
    given = files(tmp_path, timed=False, off_m=1.5e-3, noise_m=2e-4)
    said = said_of(capsys, "identify", *given)
    assert said.out.startswith(
        "Do not use this identification: its residual is 0.64 mm where noise_m and rounded joints"
    )
    assert "Is four the maker's nominal arm" in said.out
    assert "if the model is right, from line 9" in said.err + said.out


def test_what_does_not_fit_is_one_line(tmp_path, capsys):
    given = files(tmp_path, timed=False)
    (tmp_path / "wire.csv").write_text("range_mm\n400\n401\n")
    assert_rejected(said_of(capsys, "identify", *given), f"wire.csv: 2 ranges for {ROWS} rows of")
    (tmp_path / "wire.csv").write_text("t_s,range_mm\n" + "".join(f"{k / 10},400\n" for k in range(30)))
    assert_rejected(said_of(capsys, "identify", *given), "joints.csv: line 1: a column t_s is needed")
    (tmp_path / "references.toml").write_text('[imu]\nkind = "inertial"\n')
    assert_rejected(said_of(capsys, "identify", *given), "0 tables of kind range; expected one, with a source")
    files(tmp_path, timed=False)
    with_positions(tmp_path, "x,y,z", "100,200,300")
    assert_rejected(said_of(capsys, "identify", *given), "joints.csv: positions of up to 300 m: name x_mm, y_mm, z_mm")


def test_lost_ranges_are_left_out_and_a_wrong_unit_is_named(tmp_path, capsys):
    given = files(tmp_path, timed=True)
    head, *rows = (tmp_path / "wire.csv").read_text().splitlines()
    few = [head, *rows[5:50], *rows[55:]]  # of the first row and of another
    (tmp_path / "wire.csv").write_text("\n".join(few) + "\n")
    found = said_of(capsys, "identify", *given, "--json").one
    assert found["poses"] == ROWS - len(HOOKED) - 2
    assert "line 2, 12: 2 rows without a range at rest within 0.25 s: left out" in json.dumps(found)
    (tmp_path / "wire.csv").write_text("\n".join([head, *rows[:100]]) + "\n")
    assert_rejected(said_of(capsys, "identify", *given), "20 of 80 rows", "did the arm rest there?", "one clock")
    between = [
        f"{float(row.split(',')[0]) + 1.1},{row.split(',')[1]}" for row in rows
    ]  # half a pose late: of both beside
    apart = [f"{float(row.split(',')[0]) * 0.2},{row.split(',')[1]}" for row in between]
    joints = (tmp_path / "joints.csv").read_text().splitlines()
    closer = [joints[0], *(f"{float(row.split(',')[0]) * 0.2},{row.split(',', 1)[1]}" for row in joints[1:])]
    (tmp_path / "joints.csv").write_text("\n".join(closer) + "\n")
    (tmp_path / "wire.csv").write_text("\n".join([head, *apart]) + "\n")
    assert_rejected(said_of(capsys, "identify", *given), "a range at rest within 0.25 s of", "one clock")
    (tmp_path / "joints.csv").write_text("\n".join(joints) + "\n")
    (tmp_path / "wire.csv").write_text("\n".join([head.replace("_mm", "_in"), *rows]) + "\n")
    assert_rejected(said_of(capsys, "identify", *given), "the ranges vary by", "is their unit right")
