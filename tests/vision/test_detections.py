import json

import numpy as np
import pytest

from armsight.data import Body
from armsight.errors import InputError
from armsight.vision.camera_file import read_camera, read_cameras
from armsight.vision.detections import read_detections
from asserts import one_line

BODY = Body("ball", ("9", "10", "11", "12", "13"), np.arange(15.0).reshape(5, 3))
HEADER = "shot,camera,marker,u_px,v_px\n"


@pytest.fixture
def read(tmp_path):
    def reader(text):
        (tmp_path / "d.csv").write_text(text)
        return read_detections(tmp_path / "d.csv", BODY)

    return reader


def test_lines_become_shots_in_the_files_order(read):
    shots = read(HEADER + "7,left,12,1.5,2.5\n\n7,right,9,3,4\n 2 , left , 9 ,5,6\n7,left,10,1e1,-8\n")
    assert [s.name for s in shots] == ["7", "2"]
    assert shots[0].ids[0].tolist() == [3, 1]
    assert shots[0].uv[0].tolist() == [[1.5, 2.5], [10.0, -8.0]]
    assert shots[0].ids[1].tolist() == [0]
    assert shots[1].ids[1].size == 0
    assert shots[1].uv[1].shape == (0, 2)


def test_columns_may_stand_anywhere_and_a_marker_twice(read):
    (shot,) = read("v_px,marker,extra,u_px,camera,shot\n2,9,x,1,left,1\n4,9,y,3,left,1\n")
    assert shot.ids[0].tolist() == [0, 0]
    assert shot.uv[0].tolist() == [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize(
    ("text", "texts"),
    [
        ("", "empty; expected a header shot,camera,marker,u_px,v_px"),
        (HEADER, "no detections below the header"),
        ("shot,camera,u_px\n", "line 1: no column marker, v_px"),
        (HEADER + "1,left,9,1\n", "line 2: 4 fields, the header has 5"),
        (HEADER + "1,left,9,1,2\n1,top,9,1,2\n", "line 3: camera 'top'; it must be left or right"),
        (HEADER + "1,left,99,1,2\n", "line 2: unknown marker '99'; body ball has 9, 10, 11, 12, 13"),
        (HEADER + "1,left,9,one,2\n", "line 2: u_px is 'one', it must be a number"),
        (HEADER + "1,left,9,1,\n", "line 2: v_px is '', it must be a number"),
        (HEADER + "1,left,9,1,NaN\n", "line 2: v_px is NaN, it must be a finite number of pixels"),
        (HEADER + "1,left,9,-inf,2\n", "line 2: u_px is -inf"),
    ],
)
def test_what_a_table_may_not_hold(read, tmp_path, text, texts):
    with one_line(texts, begins=f"{tmp_path / 'd.csv'}: "):
        read(text)


def test_a_table_that_is_not_there_or_not_text(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_detections(tmp_path / "d.csv", BODY)
    (tmp_path / "d.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        read_detections(tmp_path / "d.csv", BODY)


def test_a_table_as_a_spreadsheet_saves_it(read, tmp_path):
    (tmp_path / "d.csv").write_bytes(b"\xef\xbb\xbf" + (HEADER + "1,left,9,1,2\n").replace("\n", "\r\n").encode())
    assert read_detections(tmp_path / "d.csv", BODY)[0].name == "1"


@pytest.mark.parametrize("marker", ["9\x00", "9" * 200_000], ids=["null byte", "field without end"])
def test_no_text_of_a_marker_is_more_than_a_mistake_in_one_line(read, marker):
    with pytest.raises(InputError):
        read(HEADER + f"1,left,{marker},1,2\n")


# The intrinsics that --cameras takes.

K = [[900.0, 0, 640], [0, 905, 360], [0, 0, 1]]
CAMERAS = {
    "image_size_px": [1280, 720],
    "left": {"K": K, "distortion": [0.1, 0.01, 0.001, 0.002, 0.0]},
    "right": {"K": K, "distortion": [0.1, 0.01, 0, 0], "distortion_model": "fisheye", "image_size_px": [1300, 730]},
}


@pytest.fixture
def cameras(tmp_path):
    def reader(document):
        text = document if isinstance(document, str) else json.dumps(document)
        (tmp_path / "c.json").write_text(text)
        return read_cameras(tmp_path / "c.json")

    return reader


def test_both_cameras_are_read(cameras):
    left, right = cameras(CAMERAS)
    assert (left.model, right.model) == ("brown5", "fisheye")
    assert (left.image_size_px, right.image_size_px) == ((1280, 720), (1300, 730))
    assert left.intrinsics.tolist() == [900, 905, 640, 360]
    assert left.distortion.tolist() == CAMERAS["left"]["distortion"]


@pytest.mark.parametrize(("count", "model"), [(0, "none"), (4, "brown4"), (5, "brown5"), (8, "brown8")])
def test_the_count_of_coefficients_is_the_model(cameras, count, model):
    left, _ = cameras({**CAMERAS, "left": {"K": K, "distortion": [0.01] * count}})
    assert left.model == model


@pytest.mark.parametrize(
    ("left", "texts"),
    [
        ({"distortion": []}, "camera left: has no camera matrix"),
        ({"K": K}, "camera left: has no distortion"),
        ({"K": K, "distortion": [0.1] * 3}, "camera left: 3 distortion coefficients; OpenCV's models have 0, 4, 5, 8"),
        (
            {"K": K, "distortion": [0.1] * 5, "distortion_model": "fisheye"},
            "camera left: a fisheye camera has four coefficients",
        ),
        ({"K": [[900, 1, 640], [0, 905, 360], [0, 0, 1]], "distortion": []}, "skew is not supported"),
        ({"K": [[900, 0, 640], [0, 905, 360]], "distortion": []}, "camera left: K"),
        ({"K": "900", "distortion": []}, "camera left: K"),
        ({"K": K, "distortion": ["a"]}, "camera left: distortion"),
        ({"K": K, "distortion": [float("nan")] * 4}, "camera left"),
        ({"K": [[-900, 0, 640], [0, 905, 360], [0, 0, 1]], "distortion": []}, "camera left"),
        ({"K": K, "distortion": [], "image_size_px": [1280]}, "camera left: image size has shape"),
        ({"K": K, "distortion": [], "image_size_px": "wide"}, "camera left: image size must be numbers"),
        ({"K": K, "distortion": [], "image_size_px": [0, 720]}, "camera left"),
    ],
)
def test_what_a_camera_may_not_be(cameras, tmp_path, left, texts):
    with one_line(texts, begins=f"{tmp_path / 'c.json'}: "):
        cameras({**CAMERAS, "left": left})


@pytest.mark.parametrize(
    ("document", "texts"),
    [
        ("{", "line 1: not JSON"),
        ("", "holds nothing"),
        ([], "holds a list"),
        ({"left": {}}, 'with "left" and "right"'),
        ({"left": 3, "right": 4}, 'with "left" and "right"'),
        ("[" * 100_000, "c.json"),
    ],
)
def test_what_a_camera_file_may_not_be(cameras, document, texts):
    with pytest.raises(InputError, match=texts):
        cameras(document)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("ros.yaml", "image_width: 640\nimage_height: 480\ncamera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 501, 240, 0, 0, 1]}\n"
         "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 4, data: [1e-2, 0, 0, 0]}\n"),
        ("echo.txt", "width: 640\nheight: 480\ndistortion_model: plumb_bob\nD: [1e-2, 0.0, 0.0, 0.0]\n"
         "K: [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]\n---\n"),
        ("opencv.yml", "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
         "   dt: d\n   data: [ 500., 0., 320., 0., 501., 240., 0., 0., 1. ]\ndistortion_coefficients: !!opencv-matrix\n"
         "   rows: 4\n   cols: 1\n   dt: d\n   data: [ 1e-2, 0., 0., 0. ]\n"),
        ("own.json", '{"image_size_px": [640, 480], "K": [[500, 0, 320], [0, 501, 240], [0, 0, 1]], "distortion": [0.01, 0, 0, 0]}'),
        ("kalibr.yaml", "cam0:\n  camera_model: pinhole\n  intrinsics: [500, 501, 320, 240]\n  distortion_model: radtan\n"
         "  distortion_coeffs: [0.01, 0, 0, 0]\n  resolution: [640, 480]\n"),
        ("left.cameramodel", "# mrcal\n{'lensmodel': 'LENSMODEL_OPENCV4', 'intrinsics': [500, 501, 320, 240, 0.01, 0, 0, 0], 'imagersize': [640, 480]}"),
    ],
)  # fmt: skip
def test_one_camera_of_any_program(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    camera = read_camera(tmp_path / name)
    assert camera.image_size_px == (640, 480)
    assert camera.intrinsics.tolist() == [500, 501, 320, 240]
    assert camera.distortion.tolist() == [0.01, 0, 0, 0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\n", "holds no camera, expected one: .*there are a"),
        ("left: {K: [[1]]}\nright: {K: [[1]]}\n", "camera|K"),
        ("target_type: aprilgrid\n", "Kalibr's target file"),
        ("K: [500, 0, 320, 0, 501, 240, 0, 0, 1]\nD: []\n", "c.yaml: holds no image size"),
        # mrcal's lenses whose numbers are as many as OpenCV's: STEREOGRAPHIC four, CAHVOR nine
        *(
            (
                f"{{'lensmodel': '{lens}', 'intrinsics': {[600, 600, 320, 240, *more]}, 'imagersize': [640, 480]}}",
                f"c.yaml: lens {lens} is",
            )
            for lens, more in (("LENSMODEL_STEREOGRAPHIC", []), ("LENSMODEL_CAHVOR", [0.01, 0.02, 0.001, -0.1, 0.01]))
        ),
    ],
)
def test_what_is_no_camera_is_named_with_its_file(tmp_path, text, said):
    (tmp_path / "c.yaml").write_text(text)
    with one_line("c.yaml", match=said):
        read_camera(tmp_path / "c.yaml")
