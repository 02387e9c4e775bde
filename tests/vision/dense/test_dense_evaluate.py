"""Metrics of the benchmark, its files and folders, against counting by hand and against OpenCV's reader."""

import cv2
import numpy as np
import pytest
from dense_scenes import layers

from armsight.errors import InputError
from armsight.vision.dense.evaluate import TrueDisparity, evaluate_disparity, seen_by_right
from armsight.vision.dense.middlebury import find_scenes, load_scene, read_pfm, write_pfm


def test_metrics_are_those_counted_by_hand():
    truth = TrueDisparity(np.array([[10.0, 10.0, 10.0, 10.0, np.nan]]), np.array([[True, True, True, False, True]]))
    d = np.array([[10.4, 11.5, np.nan, 15.0, 3.0]])
    whole, nonocc = evaluate_disparity(d, truth, truth.known), evaluate_disparity(d, truth, truth.seen)
    assert whole.pixels == 4
    assert whole.bad_percent == (75, 75, 50, 50)
    assert whole.average_px == pytest.approx((0.4 + 1.5 + 5) / 3)
    assert whole.rms_px == pytest.approx(np.sqrt((0.4**2 + 1.5**2 + 5**2) / 3))
    assert whole.quantiles_px[0] == pytest.approx(1.5)
    assert nonocc.pixels == 3
    assert nonocc.bad_percent == pytest.approx((200 / 3, 200 / 3, 100 / 3, 100 / 3))


def test_nothing_to_evaluate_is_nan_and_nothing_given_is_all_bad():
    truth = TrueDisparity(np.array([[5.0]]), np.array([[True]]))
    assert evaluate_disparity(np.array([[np.inf]]), truth, truth.known).bad_percent == (100,) * 4
    assert np.isnan(evaluate_disparity(np.array([[1.0]]), truth, np.array([[False]])).bad_percent).all()


def test_occlusion_follows_from_the_truth():
    d = np.full((1, 30), 2.0)
    d[0, 15:20] = 8.0
    seen = seen_by_right(d)[0]
    # The near piece covers columns 7 to 11 of the right image, that is 9 to 13 of the wall; 0 and 1 fall outside.
    assert list(np.flatnonzero(~seen)) == [0, 1, 9, 10, 11, 12, 13]


@pytest.mark.opencv
def test_pfm_goes_round_and_opencv_reads_it(tmp_path):
    rng = np.random.default_rng(0)
    image = rng.normal(size=(7, 5)).astype(np.float32)
    write_pfm(tmp_path / "a.pfm", image)
    np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), image)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.pfm"), cv2.IMREAD_UNCHANGED), image)
    image[2, 3] = np.nan
    write_pfm(tmp_path / "a.pfm", image)
    assert read_pfm(tmp_path / "a.pfm")[2, 3] == np.inf
    big = b"Pf\n2 1\n1.0\n" + np.array([1.5, 2.5], ">f4").tobytes()
    (tmp_path / "b.pfm").write_bytes(big)
    np.testing.assert_array_equal(read_pfm(tmp_path / "b.pfm"), [[1.5, 2.5]])


@pytest.mark.parametrize(
    "data", [b"", b"PF\n1 1\n-1\n" + bytes(12), b"Pf\n2 2\n-1\n" + bytes(8), b"Pf\nx y\n-1\n" + bytes(8)]
)
def test_what_is_no_pfm_is_rejected_by_name(tmp_path, data):
    (tmp_path / "a.pfm").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.pfm"):
        read_pfm(tmp_path / "a.pfm")


def write_scene(folder, names, truth, scale):
    left, right, _ = layers()
    folder.mkdir()
    for name, image in zip(names, (left, right), strict=False):
        cv2.imwrite(str(folder / f"{name}.png"), image)
    if scale is None:
        write_pfm(folder / f"{names[2]}.pfm", np.where(np.isfinite(truth), truth, np.inf).astype(np.float32))
    else:
        cv2.imwrite(str(folder / f"{names[2]}.png"), np.rint(np.nan_to_num(truth) * scale).astype(np.uint8))


@pytest.mark.parametrize(
    ("name", "names", "scale"),
    [
        ("tsukuba", ("im3", "im4", "disp3"), 16),
        ("venus", ("im2", "im6", "disp2"), 8),
        ("Bike", ("im0", "im1", "disp0"), None),
        ("Bike2", ("im0", "im1", "disp0GT"), None),
        ("Aloe", ("view1", "view5", "disp1"), round(1240 / 200)),
    ],
)
def test_layouts_are_known_with_their_scale(tmp_path, name, names, scale):
    truth = layers()[2].disparity.copy()
    truth[truth > 15] = 11  # so that every scale fits a byte
    truth[:3] = np.nan
    write_scene(tmp_path / name, names, truth, scale)
    if scale is None:
        (tmp_path / name / "calib.txt").write_text("cam0=[1 0 0; 0 1 0; 0 0 1]\nndisp=40\n")
    assert find_scenes(tmp_path) == [tmp_path / name]
    scene = load_scene(tmp_path / name)
    np.testing.assert_allclose(scene.truth.disparity, truth)
    assert scene.search.count == (40 if scale is None else 16)


def test_a_mask_says_what_both_cameras_see(tmp_path):
    write_scene(tmp_path / "PianoL", ("im0", "im1", "disp0GT"), layers()[2].disparity, None)
    mask = np.full((120, 200), 255, np.uint8)
    mask[:, :50] = 128
    cv2.imwrite(str(tmp_path / "PianoL" / "mask0nocc.png"), mask)
    scene = load_scene(tmp_path / "PianoL")
    np.testing.assert_array_equal(scene.truth.seen, mask == 255)
    assert scene.weight == 0.5


def test_folders_without_scenes_are_rejected(tmp_path):
    for folder, word in ((tmp_path / "none", "no such folder"), (tmp_path, "neither a scene")):
        with pytest.raises(InputError, match=word):
            find_scenes(folder)
    with pytest.raises(InputError, match="known layout"):
        load_scene(tmp_path)
