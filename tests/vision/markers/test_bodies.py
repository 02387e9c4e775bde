"""Bodies from CSV and TOML, and what a user reads when a file is wrong."""

import numpy as np
import pytest

from armsight.data import Body, Detections
from armsight.errors import InputError
from armsight.geometry.rotation import from_quaternion_wxyz
from armsight.vision.markers.body_file import load_body_csv, save_body_csv
from armsight.vision.markers.targets import MARKERS, Composite, open_body, open_target
from asserts import one_line

TAG = """
[[markers]]
name = "A"
position_mm = [10, 20, 30]
{rotation}
tag = {{ family = "tag36h11", id = 3, size_mm = 40 }}
"""
UPRIGHT = TAG.format(rotation="quaternion_wxyz = [1, 0, 0, 0]")


def written(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    return str(path)


def test_a_csv_body_goes_out_and_comes_back(tmp_path):
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (5, 3)).round(9)
    body = Body("ball", ("1", "P 2", "x", "y", "z"), points)
    save_body_csv(body, tmp_path / "ball.csv")
    back = load_body_csv(tmp_path / "ball.csv")
    assert back.name == "ball"
    assert back.point_names == body.point_names
    np.testing.assert_array_equal(back.points, points)
    assert open_body(str(tmp_path / "ball.csv")).point_names == body.point_names


def test_csv_takes_both_headers_blank_lines_and_a_byte_order_mark(tmp_path):
    path = written(tmp_path, "b.csv", "\ufeffid, x ,y,z\r\n1,0,0,0\r\n\r\n 2 ,1e-1,0,0\r\n3,0,0.1,0\r\n")
    body = load_body_csv(path)
    assert body.point_names == ("1", "2", "3")
    assert body.points[1, 0] == 0.1


@pytest.mark.parametrize(
    ("lines", "texts"),
    [
        ("", ["line 1", "marker,x_m,y_m,z_m"]),
        ("a,b,c,d\n", ["line 1", "a,b,c,d", "marker,x_m,y_m,z_m"]),
        ("id,x,y,z\n1,0,0,0\n2,nan,0,0\n", ["line 3", "nan"]),
        ("id,x,y,z\n1,0,0,inf\n", ["line 2", "inf"]),
        ("id,x,y,z\n1,0,zero,0\n", ["line 2", "'zero'", "not a number"]),
        ("id,x,y,z\n1,0,0\n", ["line 2", "4 columns", "3"]),
        ("id,x,y,z\n1,0,0,0\n2,1,0,0\n1,0,1,0\n", ["line 4", "'1'", "line 2"]),
        ("id,x,y,z\n,0,0,0\n", ["line 2", "no name"]),
        ("id,x,y,z\n1,0,0,0\n2,1,0,0\n", ["3 or more", "2"]),
        ("id,x,y,z\n1,0,0,0\n2,550,0,0\n3,0,20,0\n", ["550 m", "metres"]),
    ],
)
def test_a_wrong_csv_names_file_and_line(tmp_path, lines, texts):
    with one_line(*["ball.csv", *texts]):
        load_body_csv(written(tmp_path, "ball.csv", lines))


def test_tags_sit_where_the_file_says(tmp_path):
    h = 0.02
    corners = np.array([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]])
    p = np.array([0.01, 0.02, 0.03])
    for rotation, R in [
        ("normal = [0, 0, -2]\nx_axis = [3, 0, 0]", np.eye(3)),
        # On the body's right side, upright: its face looks along +x, its right is along +z ... seen from there.
        ("normal = [1, 0, 0]\nx_axis = [0, 0, 1]", np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])),
        ("quaternion_wxyz = [1, 0, 0, 0]", np.eye(3)),
        ("quaternion_wxyz = [2, 2, 0, 0]", from_quaternion_wxyz(np.array([1.0, 1, 0, 0]))),
        ("roll_pitch_yaw_deg = [90, 0, 0]", np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])),
    ]:
        body = open_body(written(tmp_path, "b.toml", TAG.format(rotation=rotation)))
        assert body.name == "b"
        assert body.point_names == ("A.0", "A.1", "A.2", "A.3")
        np.testing.assert_allclose(body.points, p + corners @ R.T, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "texts"),
    [
        ("name = ", ["not TOML"]),
        ("title = 1", ["'title'", "name and [[markers]]"]),
        ('name = "x"', ["[[markers]]"]),
        ("[[markers]]\nposition_mm = [0, 0, 0]", ["marker 1", "name"]),
        ('[[markers]]\nname = "A"\nposition_mm = [0, 0, 0]\ncube = { side = 1 }', ["(A)", "cube", *MARKERS]),
        ('[[markers]]\nname = "A"\nposition_mm = [0, 0, 0]', ["(A)", "none", *MARKERS]),
        ('[[markers]]\nname = "A"\ntag = { id = 1 }', ["(A)", "position_mm"]),
        ('[[markers]]\nname = "A"\nposition_mm = [0, 0]\ntag = { id = 1 }', ["(A)", "position_mm", "(2,)"]),
        ('[[markers]]\nname = "A"\nposition_mm = [0, nan, 0]\ntag = { id = 1 }', ["(A)", "position_mm", "NaN"]),
        ('[[markers]]\nname = "A"\nposition_mm = [0, 0, "1"]\ntag = 3', ["(A)", "tag", "table"]),
        (TAG.format(rotation=""), ["(A)", "normal, x_axis", "quaternion_wxyz", "none"]),
        (TAG.format(rotation="normal = [0, 0, 1]"), ["(A)", "exactly one"]),
        (TAG.format(rotation="normal = [0, 0, 0]\nx_axis = [1, 0, 0]"), ["(A)", "normal", "zero"]),
        (TAG.format(rotation="normal = [0, 0, 1]\nx_axis = [1, 0, 1]"), ["(A)", "x_axis", "normal"]),
        (TAG.format(rotation="quaternion_wxyz = [1, 0, 0]"), ["(A)", "quaternion_wxyz", "(3,)"]),
        (UPRIGHT * 2, ["marker 2", "'A'", "marker 1"]),
        (UPRIGHT.replace("36h11", "99h9"), ["(A)", "tag99h9", "tag36h11"]),
        (UPRIGHT.replace("id = 3", "id = 587"), ["(A)", "587", "0 to 586"]),
        (UPRIGHT.replace("id = 3", "id = 3.0"), ["(A)", "3.0"]),
        (UPRIGHT.replace("= 40", "= 0"), ["(A)", "size_mm", "0"]),
        (UPRIGHT.replace("size_mm", "size_m"), ["(A)", "size_mm"]),
        (UPRIGHT.replace("= 40", "= 40, ink = 1"), ["(A)", "'ink'", "family"]),
        (UPRIGHT.replace("10,", "1e6,"), ["(A)", "1000 m", "mm"]),
    ],
)
def test_a_wrong_body_file_names_file_and_marker(tmp_path, text, texts):
    with one_line(*["plate.toml", *texts]):
        open_target(written(tmp_path, "plate.toml", text))


def test_one_tag_twice_on_a_body_is_rejected(tmp_path):
    with pytest.raises(InputError, match=r"marker 2 \(B\).*id 3.*'A'"):
        open_target(written(tmp_path, "b.toml", UPRIGHT + UPRIGHT.replace('"A"', '"B"')))


@pytest.mark.parametrize(
    ("spec", "texts"),
    [
        ("points.csv", ["points.csv", "detections:", "TOML"]),
        ("none.toml", ["none.toml", "no such file"]),
        ("plate", ["'plate'", "chessboard", ".toml", ".csv"]),
        ("plate.json", ["'plate.json'"]),
        ("chessbord:9x6:25mm", ["unknown board", "chessboard"]),
    ],
)
def test_what_is_no_target_says_what_is(spec, texts):
    with one_line(*texts):
        open_target(spec)


class Part:
    """A target that sees some of its points, or nothing."""

    def __init__(self, name, count, ids):
        self.body = Body(name, tuple(f"{name}{i}" for i in range(count)), np.arange(3.0 * count).reshape(count, 3))
        self.ids = ids

    def detect(self, image):
        n = len(self.ids)
        return (
            Detections(self.ids, np.ones((n, 2)), np.ones((n, 2, 2))) if n else Detections.none(f"no {self.body.name}")
        )


def test_a_body_of_several_kinds_numbers_its_points_part_by_part():
    image = np.zeros((4, 4), np.uint8)
    both = Composite("all", (Part("a", 3, np.array([0, 2])), Part("b", 2, np.array([1]))))
    assert both.body.point_names == ("a0", "a1", "a2", "b0", "b1")
    assert both.body.points.shape == (5, 3)
    assert both.detect(image).ids.tolist() == [0, 2, 4]
    one = Composite("all", (Part("a", 3, np.array([], int)), Part("b", 2, np.array([1]))))
    assert one.detect(image).ids.tolist() == [4]
    none = Composite("all", (Part("a", 3, np.array([], int)), Part("b", 2, np.array([], int))))
    assert none.detect(image).problem == "no a; no b"
