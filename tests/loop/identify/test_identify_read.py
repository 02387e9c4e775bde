"""Tables of poses that other programs wrote."""

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.loop.identify.read import read_poses

OWN = ",".join(f"q{i}_deg=J{i}" for i in range(1, 7)) + ",p1_x_mm=X,p1_y_mm=Y,p1_z_mm=Z"


def test_a_table_with_its_own_names_semicolons_and_decimal_commas_is_read(tmp_path):
    values = np.random.default_rng(0).normal(size=(30, 9)).round(3)
    lines = [";".join(f"{x:.3f}".replace(".", ",") for x in row) for row in values]
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(["J1;J2;J3;J4;J5;J6;X;Y;Z", *lines]))
    read = read_poses(path, columns=OWN)
    np.testing.assert_allclose(read.measured.q, np.deg2rad(values[:, :6]), atol=1e-15)
    with pytest.raises(InputError, match="no joint angles"):
        read_poses(path)
    with pytest.raises(InputError, match="unknown name 'q9'"):
        read_poses(path, columns="q9=J1")
    with pytest.raises(InputError, match="J7"):
        read_poses(path, columns="q1_deg=J7")


def test_rows_that_repeat_another_to_the_last_digit_count_once(tmp_path):
    path = tmp_path / "a.csv"
    rows = [f"{0.1 * k},0,0.2,0,0,{0.01 * k},0.4,{0.1 + 0.01 * k},0.3" for k in range(5)]
    head = ",".join([*(f"q{k}_rad" for k in range(1, 7)), "x_m", "y_m", "z_m"])
    path.write_text("\n".join([head, *rows, rows[1], rows[1], rows[4] + "1"]) + "\n")
    read = read_poses(path)
    assert read.lines.tolist() == [2, 3, 4, 5, 6, 9]
    assert read.notes == ("2 rows repeat another to the last digit, and are left out: line 7, line 8",)
