"""Square markers against brute-force paintings, and against what the AprilTag library says of three photographs."""

import re

import cv2
import numpy as np
import pytest
from supersampled import expose, paint, picture, project, view

from armsight.geometry.pose import pose
from armsight.vision.image import grey, read_image
from armsight.vision.markers import aruco
from armsight.vision.markers.aruco import APRILTAGS, FAMILIES, cells, family_name, family_size, find_squares
from armsight.vision.markers.square import fit_square
from armsight.vision.markers.tag import Tag, TagTarget

OUTLINE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


def scene(side_px, tilt, rotation, blur_px, code, samples=12, quiet=1.2):
    """Return a painted marker in a white plate in a grey world, and its corners."""
    size = int(1.8 * side_px)
    H = view(side_px, tilt, 0.7, rotation, (size / 2 + 0.21, size / 2 - 0.37))
    plate = 0.5 + quiet / len(code)
    marker = picture(code.astype(float), low=-0.5, high=0.5)

    def pattern(x, y):
        return np.where((np.abs(x) < plate) & (np.abs(y) < plate), marker(x, y), -0.2)

    # picture() starts at y = low as it does at x.
    return paint(pattern, H, (size, size), blur_px, samples), project(H, OUTLINE)


@pytest.mark.parametrize(
    ("side_px", "tilt", "blur_px", "noise"),
    [(40, 0.3, 1.0, 2), (24, 0.3, 0.7, 2), (90, 0.6, 0.8, 2), (45, 1.0, 0.8, 3), (30, 0.2, 0.4, 4)],
)
def test_corners_are_posed_as_well_as_predicted(side_px, tilt, blur_px, noise):
    rng = np.random.default_rng(side_px)
    code = cells("tag36h11", 17)
    errors, normalised, middles = [], [], []
    for rotation in (0.2, 1.1, 2.6, -1.9):
        painted, truth = scene(side_px, tilt, rotation, blur_px, code)
        for _ in range(12):
            fit = fit_square(expose(painted, 130, noise, rng), truth + rng.normal(0, 0.6, (4, 2)), code)
            assert fit.problem is None
            error = fit.uv - truth
            errors.append(error)
            normalised.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(fit.cov_uv), error))
            middle, cov = error.mean(axis=0), fit.cov_uv.sum(axis=0) / 16  # as if the corners were independent
            middles.append(middle @ np.linalg.solve(cov, middle))
    # A marker's four corners share one fit: 48 fits scatter by about 5%, their middles by 7 %; the model's own error stays
    # under 0.01 px. The middle is right, single corners are rather too uncertain.
    assert 0.75 < np.sqrt(np.mean(middles) / 2) < 1.25
    assert 0.6 < np.sqrt(np.mean(normalised) / 2) < 1.25
    assert np.sqrt(np.mean(np.square(errors))) < 0.05


def test_gamma_and_bleeding_print_do_not_move_the_outline():
    code = cells("DICT_4X4_50", 7)
    painted, truth = scene(48, 0.3, 0.4, 0.9, code)
    bright = 255 * ((128 + 80 * painted) / 255) ** 0.5
    rng = np.random.default_rng(1)
    fits = [
        fit_square(np.clip(np.rint(bright + rng.normal(0, 2, bright.shape)), 0, 255).astype(np.uint8), truth, code)
        for _ in range(10)
    ]
    outward = np.mean([fit.uv for fit in fits], axis=0) - truth
    assert np.abs(outward).max() < 0.03  # without the term for it: 0.15 px


@pytest.mark.parametrize("side_px", [16, 40, 100])
def test_corners_found_most_of_a_cell_off_come_home_or_are_rejected(side_px):
    code, rng = cells("tag36h11", 3), np.random.default_rng(2)
    painted, truth = scene(side_px, 0.5, 0.9, 1.0, code, samples=8)
    for _ in range(12):
        start = truth + rng.uniform(-0.3, 0.3, (4, 2)) * side_px / 8
        start[rng.integers(4)] += rng.choice([-0.75, 0.75], 2) * side_px / 8
        fit = fit_square(expose(painted, 130, 2, rng), start, code)
        if fit.problem is None:
            sigma = np.sqrt(np.trace(fit.cov_uv, axis1=1, axis2=2))
            assert (np.linalg.norm(fit.uv - truth, axis=1) < 6 * sigma + 0.05).all()


@pytest.mark.parametrize("what", ["other", "blank", "half", "outside"])
def test_what_is_not_the_marker_is_rejected(what):
    code, rng = cells("tag36h11", 3), np.random.default_rng(3)
    painted, truth = scene(40, 0.2, 0.3, 0.8, code, samples=8)
    image = expose(painted, 130, 2, rng)
    if what == "other":
        code = cells("tag36h11", 4)
    elif what == "blank":
        image[:] = 90
    elif what == "half":
        image[:, image.shape[1] // 2 :] = 128
    else:
        truth = truth - 60
    assert fit_square(image, truth, code).problem


def test_upright_is_whose_name_it_bears():
    for april, opencv in APRILTAGS.items():
        np.testing.assert_array_equal(cells(april, 5), np.rot90(cells(opencv, 5), 2))
    # The AprilTag project's code of 36h11 number 0, row by row from the upper left.
    code = [int(bit) for bit in f"{0xD5D628584:036b}"]
    np.testing.assert_array_equal((cells("tag36h11", 0)[1:7, 1:7] > 0).ravel(), code)
    rendered = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 6)
    np.testing.assert_array_equal(cells("DICT_4X4_50", 7) > 0, rendered > 0)


@pytest.mark.opencv
@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_is_found_upright(family):
    identity = family_size(family) - 1
    painted, truth = scene(70, 0.2, 0.4, 0.6, cells(family, identity), samples=4)
    found = find_squares(expose(painted, 130, 1, np.random.default_rng(4)), family)
    assert [number for number, _ in found] == [identity]
    assert np.abs(found[0][1] - truth).max() < 2


@pytest.mark.parametrize("text", ["tag36h11", "TAG36H11", "dict_5x5_100", "5X5_100", "aruco_original"])
def test_family_names_are_taken_in_any_case(text):
    assert family_name(text).lower().endswith(text.lower().removeprefix("dict_"))


def plate(*identities):
    """Return a target of tags side by side, 1.5 sides apart."""
    tags = [
        Tag(f"T{i}", "tag36h11", number, 1.0, pose(np.eye(3), np.array([1.5 * i, 0.0, 0.0])))
        for i, number in enumerate(identities)
    ]
    return TagTarget("plate", tuple(tags))


def seen(*identities):
    """Return a painted view of such tags in a row, and their corners."""
    strip = np.ones((8, 12 * len(identities) - 4))
    for i, number in enumerate(identities):
        strip[:, 12 * i : 12 * i + 8] = cells("tag36h11", number)
    marker = picture(strip, low=-0.5, high=1.5 * len(identities) - 1.0)
    H = view(50.0, 0.2, 0.3, 0.1, (60.3, 60.2))
    corners = np.concatenate([OUTLINE + np.array([1.5 * i, 0.0]) for i in range(len(identities))])
    return paint(marker, H, (120, 75 * len(identities) + 60), 0.7, 6), project(H, corners)


@pytest.mark.opencv
def test_a_body_is_found_with_its_points_in_order():
    painted, truth = seen(30, 2, 11)
    found = plate(30, 2, 11).detect(expose(painted, 130, 2, np.random.default_rng(5)))
    assert found.ids.tolist() == list(range(12))
    assert np.abs(found.uv - truth).max() < 0.06
    other_order = plate(11, 30).detect(expose(painted, 130, 2, np.random.default_rng(5)))
    assert np.abs(other_order.uv - truth[[8, 9, 10, 11, 0, 1, 2, 3]]).max() < 0.06


def test_plain_tags_are_read_quickly_and_only_what_is_left_is_searched_again(monkeypatch):
    painted, truth = seen(30, 2, 11)
    image, slow = expose(painted, 130, 2, np.random.default_rng(5)), []
    nothing = np.zeros((0, 4, 2)), np.zeros(0, np.int32)
    monkeypatch.setattr(aruco, "detect_markers", lambda *_: slow.append(1) or nothing)
    found = dict(find_squares(image, "tag36h11", requested=[30, 11]))
    assert sorted(found) == [2, 11, 30]
    assert np.abs(np.concatenate([found[k] for k in (30, 2, 11)]) - truth).max() < 0.5
    assert find_squares(np.full((90, 120), 128, np.uint8), "tag36h11") == []
    assert not slow
    low, high = truth[4:8].min(axis=0).astype(int), truth[4:8].max(axis=0).astype(int)
    image[low[1] + 14 : high[1] - 14, low[0] + 14 : high[0] - 14] = 120  # the code is hidden, not the outline
    assert sorted(dict(find_squares(image, "tag36h11", requested=[30, 11]))) == [11, 30]
    assert not slow
    find_squares(image, "tag36h11", requested=[30, 2])
    assert slow


def test_a_tag_seen_twice_is_left_out_and_nothing_found_says_so():
    painted, _ = seen(30, 2, 30)
    image = expose(painted, 130, 2, np.random.default_rng(6))
    found = plate(30, 2).detect(image)
    assert found.ids.tolist() == [4, 5, 6, 7]
    assert "T0 is seen 2 times" in plate(30).detect(image).problem
    assert plate(99).detect(image).problem == "no marker of the body found"


def listed(path):
    """Read the AprilTag library's corners: lower left, lower right, upper right, upper left, pixels from the corner."""
    for line in path.read_text().splitlines():
        corners = re.findall(r"\(([-\d.]+) ([-\d.]+)\)", line)
        if corners:
            yield np.array(corners, float)[::-1] - 0.5  # to upper left first; to pixels from the first pixel's centre


@pytest.mark.opencv
def test_photographs_agree_with_the_apriltag_library(data_dir):
    ours, rough, total = [], [], 0
    for path in sorted((data_dir / "tags").glob("*.txt")):
        image = grey(read_image(path.with_suffix(".jpg")))
        found = find_squares(image, "tag36h11")
        for theirs in listed(path):
            total += 1
            near = [c for number, c in found if number == 0 and np.linalg.norm((c - theirs).mean(axis=0)) < 4]
            if near:
                fit = fit_square(image, near[0], cells("tag36h11", 0))
                if fit.problem is None:
                    ours.append(fit.uv - theirs)
                    rough.append(near[0] - theirs)
    # Tags of 12 to 45 px, sharpened, on cubes whose cells stand in relief: agreement, not error.
    assert len(ours) >= 0.8 * total
    assert np.median(np.abs(ours)) < 0.3
    assert np.median(np.abs(rough)) < 0.3
    assert (
        np.abs(np.median(np.mean(ours, axis=1), axis=0)).max() < 0.25
    )  # half a pixel, had the conventions been mixed up


def processed(painted, quality):
    """Return what a cheap camera makes of a painting: a soft lens, a wide halo of sharpening, JPEG blocks."""
    image = np.clip(110 + 130 * painted, 0, 255).astype(np.float32)
    soft = cv2.GaussianBlur(image, (0, 0), 1.9)
    sharp = np.clip(soft + 1.3 * (soft - cv2.GaussianBlur(soft, (0, 0), 1.5)), 0, 255).astype(np.uint8)
    written = cv2.imencode(".jpg", sharp, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return cv2.imdecode(written, cv2.IMREAD_GRAYSCALE)


def test_blurred_and_sharpened_small_tags_are_read_by_the_nearest_code():
    plain = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    by_threshold, missed = 0, 0
    for k in range(12):
        painted, truth = scene(30, 0.3, 0.3 + 0.5 * k, 0.8, cells("tag36h11", k), samples=4)
        image = np.pad(processed(painted, 55), 20, mode="edge")
        read = plain.detectMarkers(image)[1]
        by_threshold += read is not None and k in read
        found = find_squares(image, "tag36h11")
        assert all(identity == k for identity, _ in found)
        missed += not found
        for _, corners in found:
            assert np.abs(corners - truth - 20).max() < 30 / 8  # a cell: upright, and near enough for the fit
    assert missed == 0
    assert by_threshold < 9  # otherwise these images test nothing


def test_squares_without_a_code_are_no_markers():
    rng = np.random.default_rng(7)
    for family, size in (("tag36h11", 6), ("DICT_6X6_250", 6), ("DICT_5X5_1000", 5)):
        for _ in range(20):
            cell = rng.choice([-1.0, 1.0], (size, size))  # any code, within a dark border and a white plate
            code = np.pad(cell, 1, constant_values=-1.0)
            painted, _ = scene(40, 0.3, rng.uniform(-3, 3), 0.8, code, samples=4)
            assert find_squares(np.pad(processed(painted, 80), 20, mode="edge"), family) == []
