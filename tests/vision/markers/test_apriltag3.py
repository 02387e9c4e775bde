"""AprilTag 3's families: rendered tags are found where they are, as pyapriltags finds them; nothing else is."""

import cv2
import numpy as np
import pytest

from armsight.vision.markers.apriltag3 import LAYOUTS, codes, data_cells, printed
from armsight.vision.markers.aruco import find_squares, tag_family
from armsight.vision.markers.targets import open_target

#: Count of the codes, the first and the last of them: pyapriltags 3.4.3, AprilTag 3.4.
KNOWN = {
    "tagStandard41h12": (2115, 0x1BD8A64AD10, 0x1BDC4F3B2D5),
    "tagStandard52h13": (48714, 0x4064A19651FF1, 0x4064A53F425B6),
    "tagCircle21h7": (38, 0x157863, 0x47E28),
    "tagCircle49h12": (65535, 0xC6C921D8614A, 0xC6C95C67670F),
    "tagCustom48h12": (42211, 0xD6C8AE76DFF0, 0xD6C8E905E5B5),
}
SIZE_MM = 40.0
SHOWN = 2.5  # px a mm


def render(family, identity, angle_deg=17.0, blur=0.7):
    """A tag of 100 px about the middle of an image, rotated and tilted; its inner square's corners, px."""
    layout, s = LAYOUTS[family], 24
    bits = np.pad(np.kron((printed(family, identity) > 0) * 200 + 30, np.ones((s, s))), 3 * s, constant_values=230)
    rim = (layout.cells - layout.square) // 2 + 3
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * layout.square * s + rim * s - 0.5
    a = np.radians(angle_deg)
    R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    true = (np.array([[-1, -1], [1.1, -0.9], [1, 1], [-1, 0.95]]) * SIZE_MM * SHOWN / 2) @ R.T + [320.3, 240.6]
    H = cv2.getPerspectiveTransform(square.astype(np.float32), true.astype(np.float32))
    fine = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
    large = cv2.warpPerspective(bits.astype(np.uint8), fine @ H, (2560, 1920), borderValue=230)
    image = cv2.GaussianBlur(cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA), (0, 0), blur)
    noise = np.random.default_rng(identity).normal(0, 2, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8), true


@pytest.mark.parametrize("family", LAYOUTS)
def test_the_codes_are_those_of_the_families(family):
    known = codes(family)
    count, first, second = KNOWN[family]
    assert (len(known), int(known[0]), int(known[1])) == (count, first, second)
    assert len(np.unique(known)) == count
    assert len(np.unique(data_cells(family), axis=0)) == len(data_cells(family))
    some = np.random.default_rng(1).choice(known, 20)
    apart = np.array([[bin(int(a) ^ int(b)).count("1") for b in known[:500]] for a in some])
    assert apart[apart > 0].min() >= LAYOUTS[family].distance


@pytest.mark.parametrize("angle_deg", [17.0, 105.0, 190.0, 280.0])
@pytest.mark.parametrize("family", LAYOUTS)
def test_corners_are_those_of_the_inner_square(tmp_path, family, angle_deg):
    identity = {"tagCircle21h7": 31}.get(family, 1900)
    image, true = render(family, identity, angle_deg)
    (tmp_path / "body.toml").write_text(
        'name = "b"\n[[markers]]\nname = "A"\nposition_mm = [0, 0, 0]\nnormal = [0, 0, -1]\nx_axis = [1, 0, 0]\n'
        f'tag = {{ family = "{family}", id = {identity}, size_mm = {SIZE_MM} }}\n'
    )
    target = open_target(str(tmp_path / "body.toml"))
    np.testing.assert_allclose(np.ptp(target.body.points, axis=0), [0.04, 0.04, 0], atol=1e-12)
    seen = target.detect(image)
    assert seen.problem is None
    np.testing.assert_allclose(seen.uv, true, atol=0.1)  # 0.015 px in the median of rendered tags, 0.04 at most


@pytest.mark.parametrize("family", LAYOUTS)
def test_pyapriltags_finds_the_same(family):
    pyapriltags = pytest.importorskip("pyapriltags")
    for identity in (0, 7, 30):
        image, true = render(family, identity)
        (theirs,) = pyapriltags.Detector(families=family).detect(image)
        assert theirs.tag_id == identity == find_squares(image, family)[0][0]
        np.testing.assert_allclose(theirs.corners[::-1] - 0.5, true, atol=0.5)


def test_tags_of_other_families_are_none_of_these():
    for family in LAYOUTS:
        image, _ = render(family, 12)
        assert [name for name in LAYOUTS if find_squares(image, name)] == [family]
        assert find_squares(image, "tag36h11") == []
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = np.pad(cv2.aruco.generateImageMarker(known, 5, 200), 60, constant_values=255)
    assert [name for name in LAYOUTS if find_squares(image, name)] == []


@pytest.mark.parametrize(
    ("text", "family"),
    [
        ("tagStandard41h12", "tagStandard41h12"),
        ("standard41H12", "tagStandard41h12"),
        ("36h11", "tag36h11"),
        ("4X4_50", "DICT_4X4_50"),
    ],
)
def test_names_of_families(text, family):
    assert tag_family(text) == family
