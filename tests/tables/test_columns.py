"""Columns of a CSV by their names, and the names that ``--columns`` gives them."""

import re
from dataclasses import replace

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.robot.arm_file import open_arm
from armsight.tables.cells import read_columns
from armsight.tables.columns import Columns
from armsight.tables.lengths import number
from armsight.tables.poses import read_pose_table


def test_columns_are_read_under_other_names(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("J1, J2 ,x_m,X\n1,2,3,4\n")
    columns = read_columns("q1_rad=J1, x_m = X", ("q1_rad", "q2_rad", "x_m"))
    assert columns == {"q1_rad": "J1", "x_m": "X"}
    assert list(Columns.of_csv(path, columns).at) == ["q1_rad", "J2", "(x_m)", "x_m"]
    assert read_columns(None, ("a",)) == {}
    with pytest.raises(InputError, match=r"table\.csv: line 1: no column 'J3' for q2_rad; there are J1, J2, x_m, X"):
        Columns.of_csv(path, {"q2_rad": "J3"})
    known = [f"q{k}_{unit}" for k in range(1, 9) for unit in ("rad", "deg")]
    with pytest.raises(InputError, match=r"'q3_grad'; known are q3_rad, [^,]+, [^,]+, [^,]+, \S+ and 11 more$"):
        read_columns("q3_grad=J3", known)
    with pytest.raises(InputError, match=r"'q3'; known are q3_rad, q3_deg and 14 more$"):
        read_columns("q3=J3", known)
    for text, said in (
        ("q1_rad", "expected NAME=COLUMN"),
        ("q9=J9", "unknown name 'q9'; known are q1_rad"),
        ("q1_rad=J1,q1_rad=J2", "repeats a name"),
        ("", "expected NAME=COLUMN"),
    ):
        with pytest.raises(InputError, match=f"--columns {text}: .*{said}"):
            read_columns(text, ("q1_rad", "x_m"))


def test_a_mapping_or_parts_rename_as_the_text_does():
    known = ("q1_rad", "x_m")
    for given in ({"q1_rad": "J, 1", "x_m": "X"}, ["q1_rad=J, 1", "x_m=X"]):
        assert read_columns(given, known) == {"q1_rad": "J, 1", "x_m": "X"}
    assert read_columns({}, known) == {}
    assert read_columns(["x_m", "_"], known) == ["x_m", ""]
    with pytest.raises(InputError, match="columns is a int; expected NAMES to COLUMNS"):
        read_columns(3, known)


def test_a_column_of_points_is_no_misspelt_joint(tmp_path):
    path, five = tmp_path / "only5.csv", ",".join(f"q{k}_rad" for k in range(1, 6))
    for column, said in (("p1_x_mm", "column q6_rad is missing"), ("q6", "column 'q6' is not known: is it q6_rad?")):
        path.write_text(f"{five},p2_y_mm,{column}\n1,2,3,4,5,6,7\n")
        with pytest.raises(InputError, match=rf"5 joints \(q1_rad..q5_rad\); ur10 has 6; {re.escape(said)}$"):
            Columns.of_csv(path).joint_names(6, "ur10")


def test_cells_that_are_empty_and_lines_that_end_early(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("name,x_m,y_m\na,1,\n\nb,2\n")
    table = Columns.of_csv(path)
    np.testing.assert_array_equal(table.numbers(["x_m", "y_m"], empty=True), [[1, np.nan], [2, np.nan]])
    assert table.texts("name") == ["a", "b"]
    assert table.texts("none") == ["", ""]
    with pytest.raises(InputError, match="line 2: y_m is '', not a number; finite numbers are needed"):
        table.numbers(["y_m"])
    path.write_text("x_m\nnan\n")
    with pytest.raises(InputError, match="line 2: x_m is 'nan', not a number"):
        Columns.of_csv(path).numbers(["x_m"], empty=True)
    path.write_text("x_m,x_m\n1,2\n")
    with pytest.raises(InputError, match="names a column twice: x_m"):
        Columns.of_csv(path)


@pytest.mark.parametrize(
    ("text", "value"),
    [("1D-3", 1e-3), ("\u22122.5", -2.5), (" 7 ", 7.0), ("1_000", None), ("", None), ("0x10", None), ("-inf", -np.inf)],
)
def test_one_number_parser(text, value):
    assert number(text) == value


def test_a_long_table_stays_in_its_file_and_is_read_as_a_short_one(tmp_path, monkeypatch):
    """An hour of a run at 1 kHz: the same numbers, texts, lines and errors as by the whole file at once."""
    path = tmp_path / "joints.csv"
    path.write_text('"t_s", x_m ,phase\n0,1.5,rest\n\n1,nan,"open, loop"\n2,-2e-3\n')
    tables = [Columns.of_csv(path)]
    monkeypatch.setattr("armsight.files.DOCUMENT_MB", 1e-6)
    tables.append(Columns.of_csv(path))
    assert isinstance(tables[0].rows, list)
    assert not isinstance(tables[1].rows, list)
    for table in tables:
        np.testing.assert_array_equal(table.numbers(["t_s", "x_m"], gaps=True), [[0, 1.5], [1, np.nan], [2, -2e-3]])
        assert table.texts("phase") == ["rest", "open, loop", ""]
        assert [table.line(k) for k in range(3)] == [2, 4, 5]
        with pytest.raises(InputError, match=r"joints\.csv: line 4: x_m is 'nan', not a number"):
            table.numbers(["x_m"])
    monkeypatch.setattr("armsight.tables.columns._MOST_NUMBERS", 5)
    with pytest.raises(InputError, match="3 rows of 2 numbers are too many"):
        tables[1].numbers(["t_s", "x_m"], gaps=True)


def test_a_long_table_that_changes_while_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("armsight.files.DOCUMENT_MB", 1e-6)
    path = tmp_path / "imu.csv"
    path.write_text("t_s,x_m\n0,1\n1,2\n")
    table = Columns.of_csv(path)
    with path.open("a") as file:
        file.write("2,3\n")
    np.testing.assert_array_equal(table.numbers(["x_m"]), [[1], [2]])
    path.write_text("t_s,x_m\n0,1\n")
    with pytest.raises(InputError, match=r"imu\.csv: became shorter while it was read"):
        table.numbers(["x_m"])


def test_joints_are_read_as_recorders_name_them(tmp_path):
    arm = open_arm("ur5e")
    q = np.random.default_rng(0).uniform(-1, 1, (3, 6)).round(6)
    names, order = [f"{name}_joint" for name in arm.joint_names], [2, 1, 0, 3, 4, 5]
    theirs, values = [names[k] for k in order], [",".join(map(str, row[order])) for row in q]
    zeros = ",0.0" * 12
    files = {
        "plotjuggler": (
            ",".join(["__time", *(f"/joint_states/{name}/position" for name in theirs)]),
            "{k}.05,{values}",
        ),
        "topics": (",".join(["__time", *(f"/arm/{name}" for name in theirs)]), "{k}.05,{values}"),
        "echo": ("", f"{{k}},50000000,,{','.join(theirs)},{{values}}{zeros}"),
        "echo of positions alone": ("", f"{{k}},50000000,base,{','.join(theirs)},{{values}}"),
    }
    for name, (head, line) in files.items():
        path = tmp_path / f"{name}.csv"
        path.write_text(
            "\n".join([*([head] if head else []), *(line.format(k=k, values=v) for k, v in enumerate(values))])
        )
        table = read_pose_table(path, arm=arm, only_joints=True)
        np.testing.assert_allclose(table.q, q, err_msg=name)
        np.testing.assert_allclose(table.t_s, np.arange(3) + 0.05, err_msg=name)
    degrees = ",".join(f"{name}_deg" for name in theirs)
    path.write_text(f"__time,{degrees}\n0.5," + ",".join(map(str, np.degrees(q[0][order]))))
    np.testing.assert_allclose(read_pose_table(path, arm=arm, only_joints=True).q, q[:1])
    path.write_text("__time,A,B,C,D,E,F\n0.5," + ",".join(map(str, q[0][order])))
    named = ",".join(f"{arm.joint_names[k]}={letter}" for k, letter in zip(order, "ABCDEF", strict=True))
    np.testing.assert_allclose(read_pose_table(path, arm=arm, columns=named, only_joints=True).q, q[:1])
    in_order = ",".join(["t_s", *(f"{arm.joint_names[k]}_rad" for k in order)])
    np.testing.assert_allclose(read_pose_table(path, arm=arm, columns=in_order, only_joints=True).q, q[:1])
    with pytest.raises(InputError, match=r"there are __time, A, B, C, D, E, F$"):
        read_pose_table(path, arm=arm, only_joints=True)
    path.write_text(" ".join(["timestamp", *(f"actual_q_{k}" for k in range(6))]) + "\n7.5 " + " ".join(map(str, q[0])))
    np.testing.assert_allclose(read_pose_table(path, arm=arm, only_joints=True).t_s, [7.5])


def test_joints_of_a_model_whose_names_end_in_joint(tmp_path):
    """UR's own URDF names them shoulder_pan_joint ..; files name them with the ending or without."""
    ours = open_arm("ur5e")
    arm = replace(ours, joint_names=tuple(f"{name}_joint" for name in ours.joint_names))
    path, q = tmp_path / "a.csv", np.random.default_rng(3).uniform(-1, 1, 6).round(6)
    row = ",".join(map(str, q))

    def read(names, columns=None):
        path.write_text(f"{','.join(['__time', *names])}\n0.5,{row}\n")
        return read_pose_table(path, arm=arm, columns=columns, only_joints=True).q[0]

    whole = arm.joint_names
    for names in (whole, ours.joint_names, [f"/joint_states/{name}/position" for name in whole]):
        np.testing.assert_allclose(read(names), q)
    np.testing.assert_allclose(read([f"{name}_deg" for name in whole]), np.radians(q))
    np.testing.assert_allclose(read("ABCDEF", ",".join(map("=".join, zip(whole, "ABCDEF", strict=True)))), q)
    np.testing.assert_allclose(read(["pan", *whole[1:]], "shoulder_pan_joint=pan"), q)
    with pytest.raises(InputError, match=r"column 'shoulder_pan_jont' is not known: is it shoulder_pan_joint\?"):
        read(["shoulder_pan_jont", *whole[1:]])


def test_a_long_run_of_digits_that_is_no_number_is_read_once():
    # Where parts of a pattern may share digits, this takes an hour of processor time.
    assert number("1" * 1_000_000 + "x") is None
    assert [number(text) for text in ("12.", ".5", "1.5D-3", "\u22122")] == [12.0, 0.5, 0.0015, -2.0]
