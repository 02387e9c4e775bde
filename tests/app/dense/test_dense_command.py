"""``armsight dense`` as a user types it: files, numbers, and what is said about mistakes."""

import shutil
from functools import partial

import cv2
import numpy as np
import pytest
from solids import box, see, with_noise

from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.vision.dense import METHODS
from armsight.vision.dense.middlebury import read_pfm
from armsight.vision.rig import StereoRig
from cli_runs import assert_has, assert_rejected, said_of


@pytest.fixture
def dense(capsys):
    return partial(said_of, capsys, "dense")


def noise_texture(rng, shape):
    t = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), 2)
    return np.clip(128 + 40 * t / t.std(), 0, 255).astype(np.uint8)


@pytest.fixture
def flat(tmp_path):
    """A wall at a disparity of 9 with a square at 25: paths of left and right, and the truth."""
    rng = np.random.default_rng(5)
    wall, square = noise_texture(rng, (200, 350)), noise_texture(rng, (80, 100))
    left, right, truth = wall[:, :320].copy(), wall[:, 9:329].copy(), np.full((200, 320), 9.0)
    left[60:140, 120:220], right[60:140, 95:195], truth[60:140, 120:220] = square, square, 25
    paths = tmp_path / "left.png", tmp_path / "right.png"
    for path, image in zip(paths, (left, right), strict=True):
        cv2.imwrite(str(path), image)
    return *paths, truth


@pytest.mark.parametrize("method", METHODS)
def test_a_rectified_pair(dense, flat, tmp_path, method):
    left, right, truth = flat
    out = tmp_path / "out"
    said = dense("--max-disparity", 32, left, right, "--method", method, "-o", out, "--json")
    assert said.code == 0, said.err
    assert said.err.count("note: no RIG.json: the images were taken as rectified") == 1
    (record,) = said.lines
    disparity, valid = read_pfm(out / "disparity.pfm"), cv2.imread(str(out / "valid.png"), cv2.IMREAD_UNCHANGED)
    assert disparity.shape == valid.shape == truth.shape
    assert np.isfinite(disparity).all()
    assert (disparity >= 0).all()
    assert valid.dtype == np.uint8
    assert set(np.unique(valid)) <= {0, 255}
    assert 100 * (valid == 255).mean() == pytest.approx(record["measured_percent"])
    assert np.median(np.abs(disparity - truth)[valid == 255]) < 0.1
    shares = [record[f"{name}_percent"] for name in ("measured", "hidden", "filled", "not_in_view")]
    assert sum(shares) == pytest.approx(100)
    steps = cv2.imread(str(out / "disparity.png"), cv2.IMREAD_UNCHANGED)
    assert steps.dtype == np.uint16
    np.testing.assert_allclose(steps / 64, disparity, atol=1 / 128 + 1e-4)
    assert {p.name for p in out.iterdir()} == {
        "disparity.pfm", "disparity.png", "valid.png", "state.png", "sigma.pfm", "picture.png",
    }  # fmt: skip


@pytest.mark.opencv
def test_floats_are_read_as_grey_levels(dense, flat, tmp_path):
    left, right, truth = flat
    cv2.imwrite(str(tmp_path / "left.tiff"), cv2.imread(str(left), cv2.IMREAD_UNCHANGED).astype(np.float32))
    out = tmp_path / "out"
    said = dense("--max-disparity", 32, tmp_path / "left.tiff", right, "--method", "block", "-o", out)
    assert said.code == 0, said.err
    assert np.median(np.abs(read_pfm(out / "disparity.pfm") - truth)) < 0.1


def test_the_text_says_how_much_is_measured(dense, flat, tmp_path):
    said = dense(*flat[:2], "--max-disparity", 32, "-o", tmp_path / "out")
    assert said.code == 0
    for word in ("% measured", "hidden", "filled", "written to"):
        assert word in said.out


def test_every_mistake_is_one_line(dense, flat, tmp_path):
    left, right, _ = flat
    out = ("-o", tmp_path / "out")
    ready = ("--max-disparity", 32)
    image = cv2.imread(str(right), cv2.IMREAD_UNCHANGED)
    for name, changed in {"shifted": np.roll(image, 6, axis=0), "small": image[:-2]}.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), changed)
    floats = image.astype(np.float32)
    floats[3, 4] = np.nan
    cv2.imwrite(str(tmp_path / "nan.tiff"), floats)
    assert_rejected(dense(*ready, right, left, *out), "exchanged", "right.png, ", "left.png")
    assert_rejected(dense(*ready, left, tmp_path / "shifted.png", *out), "not rectified", "px", "shifted.png")
    assert_rejected(dense(*ready, left, tmp_path / "small.png", *out), "320x200", "320x198", "small.png")
    assert_rejected(dense(*ready, left, tmp_path / "nan.tiff", *out), "nan.tiff", "1 values are NaN")
    assert_rejected(dense(*ready, "--source", tmp_path / "nowhere", *out), "nowhere", "not a source")
    assert_rejected(dense("--max-disparity", 321, left, right, *out), "outside the image")
    assert_rejected(dense("--max-disparity", 0, left, right, *out), "outside the image")
    assert_rejected(dense(left, right, *out), "no RIG.json before the images", "--max-disparity")
    assert_rejected(dense(*ready, left, *out), "LEFT RIGHT")
    assert_rejected(dense(*ready, left, tmp_path / "none.png", *out), "none.png", "no such file")
    assert_rejected(dense(left, left, right, *out), "left.png")
    assert_rejected(dense(*ready, "--near", 0.5, left, right, *out), "--near")
    assert_rejected(dense(*ready, left, right, "-o", left), "folder")
    assert_rejected(dense(*ready, left, right, "-o", left / "in"), "folder")
    assert_rejected(dense("evaluate", tmp_path, *out), "neither a scene nor a folder of scenes")
    assert not (tmp_path / "out").exists()


def test_no_texture_is_an_empty_result_with_the_reason(dense, tmp_path):
    for side in ("l", "r"):
        cv2.imwrite(str(tmp_path / f"{side}.png"), np.full((90, 160), 77, np.uint8))
    out = tmp_path / "out"
    said = dense("--max-disparity", 32, tmp_path / "l.png", tmp_path / "r.png", "-o", out, "--json")
    assert said.code == 0
    (record,) = said.lines
    assert "no texture" in record["problem"]
    assert record["measured_percent"] == 0
    assert not cv2.imread(str(out / "valid.png"), cv2.IMREAD_UNCHANGED).any()
    assert np.isinf(read_pfm(out / "disparity.pfm")).all()


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A rendered box before a wall, seen by a verging rig with distorted lenses: folder, rig and true depth."""
    folder = tmp_path_factory.mktemp("seen")
    rig = example_rig((320, 240), focal_px=300.0, baseline_m=0.12, convergence_deg=4.0)
    rng = np.random.default_rng(0)
    wall = box(np.array([4.0, 4.0, 0.02]), grain_m=0.08, seed=1)
    near = box(np.array([0.25, 0.2, 0.1]), grain_m=0.03, seed=2)
    posed = [(wall, pose(exp_so3(np.array([0.1, 0.2, 0.0])), np.array([0, 0, 1.6])))]
    posed.append((near, pose(exp_so3(np.array([0.2, -0.3, 0.1])), np.array([0.05, 0.0, 0.9]))))
    for name, camera, T in (("left", rig.left, np.eye(4)), ("right", rig.right, inverse(rig.T_left_right))):
        image, depth = see(camera, [(s, T @ P) for s, P in posed])
        cv2.imwrite(str(folder / f"{name}_00.png"), with_noise(image, 1.0, rng))
        if name == "left":
            truth = depth
    rig.save(folder / "vague.json")
    sigma = np.concatenate([np.full(4, 0.1), np.full(5, 1e-5)] * 2 + [np.full(6, 1e-5)])
    StereoRig(rig.left, rig.right, rig.T_left_right, np.diag(sigma**2), 0.1).save(folder / "rig.json")
    return folder, rig, truth


def read_ply(path):
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    kinds = {"float": "<f4", "uchar": "u1"}
    fields = [(line.split()[2], kinds[line.split()[1]]) for line in lines if line.startswith("property")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    return np.frombuffer(body, np.dtype(fields), count)


def test_a_rig_gives_depth_in_mm_and_a_cloud_in_the_left_cameras_frame(dense, seen, tmp_path):
    folder, rig, truth = seen
    out = tmp_path / "out"
    said = dense(folder / "rig.json", folder / "left_00.png", folder / "right_00.png", "-o", out, "--json")
    assert said.code == 0, said.err
    assert said.err == ""
    (record,) = said.lines
    cloud = read_ply(out / "cloud.ply")
    assert len(cloud) == record["points"] > 0.6 * truth.size
    p_left = np.stack([cloud[a] for a in "xyz"], axis=1).astype(np.float64)
    uv = np.rint(rig.left.project(p_left)).astype(int)
    z = truth[np.clip(uv[:, 1], 0, 239), np.clip(uv[:, 0], 0, 319)]
    off = np.abs(p_left[:, 2] - z)
    assert np.nanmedian(off) < 0.01  # a tenth of a pixel at 1.6 m: z^2 / (f b) = 71 mm/px
    assert np.nanmean(off <= 1.96 * cloud["sigma"]) > 0.85  # true depth is looked up to the nearest raw pixel
    depth, valid = read_pfm(out / "depth_mm.pfm"), cv2.imread(str(out / "valid.png"), cv2.IMREAD_UNCHANGED)
    assert 780 < np.percentile(depth[valid > 0], 2) < 920  # the box: its middle at 900, its corners up to 170 nearer
    assert record["median_depth_mm"] == pytest.approx(np.median(depth[valid > 0]), rel=1e-5)


def test_a_rig_of_unknown_uncertainty_is_remarked(dense, seen, tmp_path):
    folder, _, _ = seen
    pair = folder / "left_00.png", folder / "right_00.png"
    said = dense(folder / "vague.json", *pair, "--method", "block", "-o", tmp_path / "out")
    assert said.code == 0
    assert "does not say how well it is known" in said.err


def test_a_sequence_is_one_folder_a_shot(dense, seen, tmp_path):
    folder, _, _ = seen
    shots = tmp_path / "shots"
    shots.mkdir()
    for side in ("left", "right"):
        for k in range(2):
            shutil.copy(folder / f"{side}_00.png", shots / f"{side}_{k:02d}.png")
    (shots / "right_01.png").write_bytes(b"no image")
    said = dense(folder / "rig.json", "--source", shots, "--method", "block", "-o", tmp_path / "out", "--json")
    assert said.code == 0, said.err
    first, second = said.lines
    assert first["problem"] is None
    assert "right_01.png" in second["problem"]
    assert (tmp_path / "out" / first["shot"] / "cloud.ply").is_file()


def test_a_depth_too_near_is_reported(dense, seen, tmp_path):
    folder, _, _ = seen
    pair = folder / "left_00.png", folder / "right_00.png"
    assert_rejected(dense(folder / "rig.json", *pair, "--near", 0.05, "-o", tmp_path / "out"), "--near", "outside")
    assert_rejected(dense(folder / "rig.json", *pair[::-1], "-o", tmp_path / "out"), "by the rig")


@pytest.mark.opencv
def test_evaluation_has_every_method_and_metric(dense, flat, tmp_path):
    left, right, truth = flat
    scene = tmp_path / "scenes" / "Wall"
    scene.mkdir(parents=True)
    shutil.copy(left, scene / "im2.png")
    shutil.copy(right, scene / "im6.png")
    cv2.imwrite(str(scene / "disp2.png"), (truth * 6).astype(np.uint8))  # 1800 / 320 px wide: scale 6
    out = tmp_path / "out"
    said = dense("evaluate", tmp_path / "scenes", "--json", "-o", out)
    assert said.code == 0, said.err
    (found,) = said.lines
    assert [line["method"] for line in found["scenes"]] == list(METHODS)
    for line in found["scenes"]:
        for kind in ("all", "nonocc"):
            assert set(line[kind]) == {
                "pixels", "bad_0.5_percent", "bad_1_percent", "bad_2_percent", "bad_4_percent", "average_px", "rms_px",
                "a50_px", "a90_px", "a95_px", "a99_px",
            }  # fmt: skip
        assert line["nonocc"]["bad_1_percent"] < 3
        assert line["seconds"] > 0
        assert 0 < line["density_percent"] <= 100
    assert set(found["weighted_average"]) == set(METHODS)
    assert len((out / "table.csv").read_text().splitlines()) == 1 + len(METHODS)
    assert (out / "Wall_semiglobal_errors.png").is_file()
    text = dense("evaluate", scene, "--method", "block").out
    assert_has(text, "bad-0.5", "block")
    assert_rejected(dense("evaluate", tmp_path / "nothing"), "no such folder")
