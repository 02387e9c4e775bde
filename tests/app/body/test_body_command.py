"""``armsight body``: the assessment of good and bad bodies, drawings to scale, and what is typed wrongly."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from armsight.app.body import draw as body_draw
from armsight.app.body.check import SEPARATED_SIGMAS, assess
from armsight.data import Discs, Missed
from armsight.geometry.pose import inverse, transform
from armsight.vision.discs.bias import project_discs
from armsight.vision.discs.identify import identify
from armsight.vision.markers.board import open_board
from armsight.vision.markers.targets import open_target, read_layout
from armsight.vision.pose.predict import plain_rig, view
from cli_runs import assert_has, assert_rejected

PLATE = Path(__file__).resolve().parents[3] / "examples" / "plate.toml"
TRIANGLE = ((-55, 0, 0), (55, 0, 0), (0, 85, 0))
#: What a measurement on paper may be off by: the bound asked of a drawing, mm.
PAPER_MM = 0.05


def disc(name, position, normal="normal = [0, 0, -1]", radius=8.0, bright="true"):
    return (
        f'[[markers]]\nname = "{name}"\nposition_mm = {[float(c) for c in position]}\n{normal}\n'
        f"disc = {{ radius_mm = {radius}, bright = {bright} }}\n"
    )


TAG = (
    '[[markers]]\nname = "T"\nposition_mm = [0, 30, 0]\nnormal = [0, 0, -1]\nx_axis = [1, 1, 0]\n'
    'tag = { family = "tag36h11", id = 3, size_mm = 30 }\n'
)
BOARD = (
    '[[markers]]\nname = "B"\nposition_mm = [-60, 60, 0]\nnormal = [0, 0, -1]\nx_axis = [1, 0.1, 0]\n'
    'board = { spec = "SPEC" }\n'
)


@pytest.fixture
def body(tmp_path):
    """Write a body of discs and more."""

    def written(positions=TRIANGLE, more="", **looks):
        path = tmp_path / "body.toml"
        path.write_text("".join(disc(f"P{i + 1}", p, **looks) for i, p in enumerate(positions)) + more)
        return path

    return written


def regular(count, radius=60.0):
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1).tolist()


def answer(said):
    (one,) = said.lines
    return one


def kinds(assessment, grade):
    return {f["kind"] for f in assessment["findings"] if f["grade"] == grade}


def test_the_example_plate_is_usable_and_its_twin_is_settled_by_the_normals(armsight):
    said = armsight("body", "check", PLATE, "--json").done()
    got = answer(said)
    assert got["assessment"] == "usable"
    side = np.hypot(55, 85)
    assert [d["mm"] for d in got["distances_mm"]] == pytest.approx([side, side, 110.0])
    (ambiguity,) = got["ambiguities"]
    assert ambiguity["description"] == "P1 and P2 exchanged"
    assert ambiguity["from_behind"]
    assert ambiguity["settled_by_normals"]
    assert [e["disc_px"] for e in got["expected"]] == [pytest.approx([16 * 0.9 / d] * 2) for d in (0.6, 0.8, 1.2)]
    text = armsight("body", "check", PLATE).out
    assert_has(text, "assessment: usable", "P1 and P2 exchanged would fit, but seen from behind: the normals settle it")


def test_without_normals_the_same_plate_is_ambiguous_and_normals_are_asked_for(armsight, body):
    said = armsight("body", "check", body(normal=""))
    assert said.code == 1
    assert "assessment: ambiguous" in said.out
    assert "P1 and P2 exchanged, seen from behind, is the same body" in said.out
    assert "change: give every disc its normal" in said.out


@pytest.mark.parametrize(("count", "rotations"), [(3, 2), (4, 3), (5, 4)])
def test_a_regular_body_is_ambiguous_by_each_of_its_rotations_and_the_move_that_is_advised_mends_it(
    armsight, body, tmp_path, count, rotations
):
    path = body(regular(count))
    said = armsight("body", "check", path, "--json")
    assert said.code == 1
    got = answer(said)
    assert got["assessment"] == "ambiguous"
    assert sum(not s["distinguishable"] for s in got["ambiguities"]) == rotations
    assert sum(s["settled_by_normals"] for s in got["ambiguities"]) == count  # the mirror axes
    (advice,) = [f["change"] for f in got["findings"] if f["kind"] == "change"]
    name, mm, sign, axis = re.search(r"move P(\d) by (\d+) mm along ([+-])([xyz])", advice).groups()
    positions = regular(count)
    positions[int(name) - 1]["xyz".index(axis)] += float(f"{sign}{mm}")
    assert armsight("body", "check", body(positions)).code == 0


def test_the_side_of_a_body_with_a_tag_is_identified_by_the_tag(armsight, body):
    got = answer(armsight("body", "check", body(more=TAG, normal=""), "--json"))
    assert got["assessment"] == "usable"
    assert got["coded"]


def test_a_mirror_image_is_harmless_and_said(armsight, body):
    said = armsight("body", "check", body([*TRIANGLE, (0, 30, -40)], normal="")).done()
    assert "note  P1 and P2 exchanged is its mirror image: harmless to two cameras, not to one alone" in said.out


def test_nearly_equal_distances_are_distinguished_near_and_not_far(armsight, body):
    path = body(((-55, 0, 0), (61, 0, 0), (0, 95, 0)))
    near, far = (answer(armsight("body", "check", path, "--distance", d, "--json")) for d in (0.4, 1.6))
    assert near["assessment"] == "usable"
    assert far["assessment"] == "ambiguous"
    (text, *_) = [f["text"] for f in far["findings"] if f["kind"] == "ambiguous"]
    needed, assumed = map(float, re.search(r"is known to ([\d.]+) px \(assumed: ([\d.]+) px", text).groups())
    assert needed < assumed


def test_dark_and_bright_discs_are_not_taken_for_each_other(armsight, body):
    path = body(regular(3)[:2], more=disc("D", regular(3)[2], bright="false"))
    got = answer(armsight("body", "check", path, "--json"))
    assert got["assessment"] == "usable"
    assert [s["description"] for s in got["ambiguities"]] == ["P1 and P2 exchanged"]


@pytest.mark.parametrize(
    ("positions", "looks", "more", "kind", "part"),
    [
        (TRIANGLE, {"radius": 1.5}, "", "size", "4.5 px across, below 5"),
        (TRIANGLE, {"radius": 52.0}, "", "size", "156 px across, above 150"),
        (((0, 0, 0), (15, 0, 0), (0, 85, 0)), {}, "", "overlap", "P1 and P2 overlap by 1.0 mm"),
        (((-55, 0, 0), (55, 0, 0), (0, 50, 0)), {}, TAG, "overlap", "the disc P3 lies on T"),
        (((-700, 0, 0), (700, 0, 0), (0, 85, 0)), {}, "", "image", "P1, P2 are not in both images"),
        (
            TRIANGLE[:2],
            {},
            disc("B1", (0, 85, 5), "normal = [0, 0, 1]") + disc("B2", (9, 9, 5), "normal = [0, 0, 1]"),
            "view",
            "at most 2 points are seen together",
        ),
    ],
)
def test_what_makes_a_body_unusable_is_said(armsight, body, positions, looks, more, kind, part):
    said = armsight("body", "check", body(positions, more, **looks))
    assert said.code == 1
    assert "assessment: unusable" in said.out
    assert part in said.out
    assert kind in kinds(answer(armsight("body", "check", body(positions, more, **looks), "--json")), "bad")


def test_what_could_be_better_is_said_and_the_body_is_usable(armsight, body):
    close = armsight("body", "check", body(((-30, 0, 0), (-11, 0, 0), (0, 85, 0)))).done()
    assert "weak  P1 and P2 leave only 3.0 mm of plain surround" in close.out
    slim = armsight("body", "check", body(((-55, 0, 0), (65, 0, 0), (10, 20, 0))))
    assert "known least: the rotation about the body's x axis" in slim.out
    far = armsight("body", "check", body([(x, y, 400) for x, y, _ in TRIANGLE]))
    assert "the body's origin lies 401 mm from the markers' middle" in far.out


def named(rig, target, distance, rng):
    """What identification makes of a body's discs at five orientations: right, wrong or missed."""
    outcomes = []
    for rotation in ((0, 0), (0.7, 0), (-0.7, 0), (0, 0.7), (0, -0.7)):
        T = view(rig, target.body.points, target.normals, distance, rotation).T_left_body
        sides = []
        for camera, T_camera_body in ((rig.left, T), (rig.right, inverse(rig.T_left_right) @ T)):
            p, n = transform(T_camera_body, target.body.points), target.normals @ T_camera_body[:3, :3].T
            uv, shape, _, _ = project_discs(camera, p, n, target.radii_m)
            shuffled = rng.permutation(len(uv))
            noisy = uv[shuffled] + rng.normal(0, 0.02, uv.shape)
            sides.append(
                Discs(noisy, np.tile(4e-4 * np.eye(2), (len(uv), 1, 1)), shape[shuffled], target.bright[shuffled])
            )
        found = identify(rig, target, *sides)
        if isinstance(found, Missed):
            outcomes.append(found.reason.split(":")[0])
        else:
            off = transform(found.T_left_body, target.body.points) - transform(T, target.body.points)
            # Depth is known to sqrt(2) 0.02 z^2 / (f b) = 0.2 mm at 1.2 m; another naming is 100 mm off.
            outcomes.append("right" if np.abs(off).max() < 2e-3 else "wrong")
    return outcomes


@pytest.mark.parametrize(
    "positions", [TRIANGLE, regular(3), [(64, 0, 0), *regular(3)[1:]], [(-55, 0, 0), (55.4, 0, 0), (0, 95, 0)]]
)
def test_identification_names_what_is_called_usable_and_misses_what_is_called_ambiguous(armsight, body, positions):
    path = body(positions)
    for distance in (0.6, 1.2):
        said = armsight("body", "check", path, "--distance", distance, "--json")
        outcomes = set(named(plain_rig(), read_layout(path).discs, distance, np.random.default_rng(5)))
        assert outcomes == {"right" if answer(said)["assessment"] == "usable" else "ambiguous"}


def test_one_hidden_disc_is_looked_into(armsight, body):
    """Three of the four are an equilateral triangle: without the fourth they are ambiguous."""
    got = answer(armsight("body", "check", body([*regular(3), (20.0, 5.0, -40.0)]), "--json"))
    assert got["assessment"] == "usable"
    assert any("where P4 is hidden" in (f["text"] or "") for f in got["findings"])


def test_a_better_rig_knows_more_and_a_rigs_own_uncertainty_counts(armsight, rendered):
    plain = answer(armsight("body", "check", PLATE, "--distance", "0.5", "--json"))["expected"][0]
    got = answer(armsight("body", "check", PLATE, "--rig", rendered.rig, "--distance", "0.5", "--json"))
    assert str(rendered.rig) in got["cameras"]
    assert got["expected"][0]["sigma_depth_mm"] > plain["sigma_depth_mm"]


def test_the_tolerance_of_an_assessment_is_the_one_that_is_named():
    layout = read_layout(PLATE)
    assessment = assess(layout, plain_rig(), (0.6,))
    assert assessment.grade == "usable"
    assert all((one.separation_sigmas >= SEPARATED_SIGMAS).all() for one in assessment.ambiguities)


def test_what_else_is_typed_wrongly_is_one_clear_line(armsight, tmp_path, body):
    assert_rejected(armsight("body", "check", "points.csv"), "points.csv", "TOML")
    assert_rejected(armsight("body", "check", PLATE, "--distance", "0"), "--distance 0", "metres")
    assert_rejected(armsight("body", "check", PLATE, "--distance", "nan"), "--distance nan", "metres")
    assert_rejected(armsight("body", "check", PLATE, "--distance", "-1m"), "'-1m' is not a number")
    assert_rejected(armsight("body", "check", "chessboard:9x6:25mm"), "not a board")
    assert_rejected(armsight("body", "check", PLATE, "--rig", PLATE), "not JSON; expected a rig file (Expecting")
    assert_rejected(armsight("body", "check", PLATE, "--rig", tmp_path / "no.json"), "no.json", "no such file")
    assert_rejected(armsight("body", "draw", PLATE, "-o", tmp_path / "plate.docx"), "plate.docx", ".pdf")
    assert_rejected(armsight("body", "draw", PLATE, "-o", tmp_path / "plate"), ".pdf")
    for command in (["check"], ["draw", "-o", str(tmp_path / "out.pdf")]):
        assert_rejected(armsight("body", *command, body(TRIANGLE[:2], normal="")), "body.toml", "2 discs", "3 or more")
    wide = body([(10 * x, 10 * y, z) for x, y, z in TRIANGLE])
    assert_rejected(
        armsight("body", "draw", wide, "-o", tmp_path / "wide.pdf"), "P1, P2, P3", "a4 is 210 x 297", "--paper fit"
    )
    assert_rejected(
        armsight("body", "draw", wide, "-o", tmp_path / "wide.png", "--paper", "fit", "--dpi", "2400"), "--dpi"
    )
    bent = body(TRIANGLE, disc("Q", (0, 0, 40), normal=""))
    assert_rejected(armsight("body", "draw", bent, "-o", tmp_path / "bent.pdf"), "not flat", "Q needs its normal")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["body.toml"]


def test_without_matplotlib_drawing_says_what_to_install(armsight, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert_rejected(
        armsight("body", "draw", PLATE, "-o", tmp_path / "p.pdf"), "matplotlib", 'pip install "armsight[report]"'
    )


DPI = 300
PX_PER_MM = DPI / 25.4


def pages_of(armsight, path, folder, *more):
    """Draw as PNG and return the pages, grey."""
    said = armsight("body", "draw", path, "-o", folder / "pages.png", "--dpi", DPI, "--json", *more).done()
    return [cv2.imread(name, cv2.IMREAD_GRAYSCALE) for name in answer(said)["files"]]


def measured_disc(image, middle, radius_px, bright):
    """Centre and radius of a disc on its plain surround by moments of grey, mm on the paper."""
    x, y = (round(float(c)) for c in middle)
    half = int(1.6 * radius_px)
    window = image[y - half : y + half + 1, x - half : x + half + 1].astype(float)
    brightness = window if bright else 255.0 - window
    rows, columns = np.mgrid[y - half : y + half + 1, x - half : x + half + 1]
    area = brightness.sum() / 255.0
    centre = np.array([(brightness * columns).sum(), (brightness * rows).sum()]) / brightness.sum()
    return centre / PX_PER_MM, np.sqrt(area / np.pi) / PX_PER_MM


def blobs(image, bright, radius_px):
    """Rough middles of what has the area of a disc and is round, px."""
    mask = (image > 127) if bright else (image <= 127)
    _, _, stats, middles = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    round_ = np.abs(stats[:, cv2.CC_STAT_AREA] / (np.pi * radius_px**2) - 1) < 0.02
    square = np.abs(stats[:, cv2.CC_STAT_WIDTH] - stats[:, cv2.CC_STAT_HEIGHT]) < 3
    return middles[round_ & square]


@pytest.mark.parametrize("bright", [True, False])
@pytest.mark.parametrize("paper", ["a4", "letter", "fit"])
def test_discs_are_plotted_to_scale(armsight, body, tmp_path, bright, paper):
    path = body(((-50, -10, 0), (55, 0, 0), (5, 85, 0)), radius=6.35, bright=str(bright).lower())
    (image,) = pages_of(armsight, path, tmp_path, "--paper", paper)
    if paper != "fit":
        assert image.shape[::-1] == tuple(int(mm * PX_PER_MM) for mm in body_draw.PAPERS[paper])
    radius_px = 6.35 * PX_PER_MM
    found = [measured_disc(image, middle, radius_px, bright) for middle in blobs(image, bright, radius_px)]
    assert len(found) == 3
    assert [radius for _, radius in found] == pytest.approx([6.35] * 3, abs=PAPER_MM)
    centres = np.array(sorted((tuple(c) for c, _ in found), key=lambda c: c[1]))
    expected = np.array([(-50, -10), (55, 0), (5, 85)])  # seen from -z: x to the right, y down, not mirrored
    np.testing.assert_allclose(centres - centres[0], expected - expected[0], atol=PAPER_MM)


def test_the_bar_is_as_long_as_it_says(armsight, tmp_path):
    (image,) = pages_of(armsight, PLATE, tmp_path)
    low = image[int(0.9 * len(image)) :] < 128
    (row,) = np.unravel_index(low.sum(axis=1).argmax(), (len(low),))
    columns = np.flatnonzero(low[row])
    ends = columns[np.flatnonzero(np.diff(columns) > 1)] if (np.diff(columns) > 1).any() else columns[-1:]
    # A line's ends and its ticks are half a stroke (0.3 pt) beyond it at the most.
    assert (ends[0] - columns[0] + 1) / PX_PER_MM == pytest.approx(100.0, abs=PAPER_MM + 0.3 / 72 * 25.4 * 2)


@pytest.mark.parametrize(
    "spec", ["tag", "chessboard:7x4:10mm", "charuco:8x5:15mm:11mm:DICT_5X5_100", "aprilgrid:3x2:20mm:0.3"]
)
def test_tags_and_boards_are_plotted_to_scale_and_found_where_the_body_has_them(armsight, body, tmp_path, spec):
    path = body(more=TAG if spec == "tag" else BOARD.replace("SPEC", spec))
    if spec != "tag":
        path = body(((-80, 0, 0), (55, 0, 0)), more=BOARD.replace("SPEC", spec))
    (image,) = pages_of(armsight, path, tmp_path)
    target = open_target(str(path))
    found = target.detect(cv2.GaussianBlur(image, (0, 0), 0.8))
    assert found.problem is None
    points = 1e3 * target.body.points[found.ids, :2]
    assert len(points) >= 4
    # A similarity without a mirror image: complex numbers, least squares.
    p, q = points @ [1, 1j], found.uv / PX_PER_MM @ [1, 1j]
    (scale, shift), *_ = np.linalg.lstsq(np.stack([p, np.ones_like(p)], axis=1), q)
    assert scale == pytest.approx(1.0, abs=PAPER_MM / np.ptp(points, axis=0).max())
    assert np.abs(scale * p + shift - q).max() < PAPER_MM


def test_each_plane_has_its_page(armsight, body, tmp_path):
    side = "".join(
        disc(f"S{i}", (60, y, z), normal="normal = [1, 0, 0]") for i, (y, z) in enumerate([(0, 10), (40, 20), (10, 60)])
    )
    path = body(more=side)
    said = armsight("body", "draw", path, "-o", tmp_path / "two.png", "--dpi", DPI)
    assert "note: the body is not flat: 2 planes, a page each" in said.err
    assert said.out.splitlines()[:2] == ["page 1: P1, P2, P3", "page 2: S0, S1, S2"]
    image = cv2.imread(str(tmp_path / "two-2.png"), cv2.IMREAD_GRAYSCALE)
    radius_px = 8 * PX_PER_MM
    centres = np.array([measured_disc(image, m, radius_px, True)[0] for m in blobs(image, True, radius_px)])
    centres = centres[np.argsort(centres[:, 1])]
    # Seen from +x with y down, z runs to the right: y x (-x) = z.
    expected = np.array([(10, 0), (60, 10), (20, 40)], float)
    np.testing.assert_allclose(centres - centres[0], expected - expected[0], atol=PAPER_MM)


def test_a_bright_disc_beside_a_tag_keeps_its_surround_off_it(armsight, body, tmp_path):
    path = body(((-29, 30, 0), (55, 0, 0), (0, 85, 0)), more=TAG.replace("[1, 1, 0]", "[1, 0, 0]"))
    said = armsight("body", "draw", path, "-o", tmp_path / "near.png", "--dpi", DPI)
    # The tag reaches 15 mm and its white margin a square of 30/8 mm: 29 - 18.75 - 8 mm are left.
    assert "P1 has only 2.2 mm of dark surround" in said.err
    image = cv2.imread(str(tmp_path / "near.png"), cv2.IMREAD_GRAYSCALE)
    assert len(open_target(str(path)).detect(cv2.GaussianBlur(image, (0, 0), 0.8)).ids) == 4


def test_pdf_and_svg_have_the_papers_size_and_are_the_same_each_time(armsight, tmp_path):
    for name in ("one.pdf", "two.pdf", "one.svg"):
        assert armsight("body", "draw", PLATE, "-o", tmp_path / name).code == 0
    pdf = (tmp_path / "one.pdf").read_bytes()
    (box,) = re.findall(rb"/MediaBox \[ ?([\d. ]+) ?\]", pdf)
    points = [float(n) for n in box.split()]
    assert points == pytest.approx([0, 0, 210 / 25.4 * 72, 297 / 25.4 * 72], abs=PAPER_MM / 25.4 * 72)
    assert pdf == (tmp_path / "two.pdf").read_bytes()
    svg = (tmp_path / "one.svg").read_text()
    width, height = re.search(r'width="([\d.]+)pt" height="([\d.]+)pt"', svg).groups()
    assert [float(width), float(height)] == pytest.approx([210 / 25.4 * 72, 297 / 25.4 * 72], abs=0.01)


def test_names_that_are_not_plain_are_plotted(armsight, body, tmp_path):
    path = body()
    path.write_text(path.read_text().replace('"P1"', '"$x^2$"').replace('"P2"', '"\\u6e2c\\u5b9a"'))
    assert armsight("body", "draw", path, "-o", tmp_path / "names.pdf").code == 0


def test_a_drawing_that_fails_leaves_nothing_behind(armsight, tmp_path, full_disk, body):
    shutil.copy(PLATE, tmp_path / "plate.toml")
    assert_rejected(armsight("body", "draw", tmp_path / "plate.toml", "-o", full_disk / "plate.png"), "plate.png")
    assert [p.name for p in full_disk.iterdir()] == ["ballast"]


def test_the_command_ends_with_its_code():
    run = subprocess.run([sys.executable, "-m", "armsight.app.main"], capture_output=True, text=True, check=False)
    assert run.returncode == 0
    code = "from armsight.app.main import main; main()"
    arguments = [sys.executable, "-c", code, "body", "check", str(PLATE), "--json", "--distance", "5"]
    run = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert json.loads(run.stdout)["assessment"] == "unusable"


SHEET_SPECS = [
    "chessboard:7x4:20mm",
    "charuco:8x5:20mm:15mm:DICT_5X5_100",
    "acircles:4x5:20mm",
    "aprilgrid:3x2:40mm:0.3",
]


@pytest.mark.parametrize(
    "spec",
    [*SHEET_SPECS, "circles:6x5:20mm", "circles:6x5:20mm:radius=7mm:light", "circles:6x5:20mm:rings=1x1,4x1,1x3"],
)
def test_a_board_is_drawn_from_its_spec_and_found_at_its_scale(armsight, tmp_path, spec):
    (image,) = pages_of(armsight, spec, tmp_path)
    board = open_board(spec)
    found = board.detect(cv2.GaussianBlur(image, (0, 0), 0.8))
    assert len(found.ids) == len(board.body.points), found.problem
    order = min((np.arange(len(found.ids)), *board.symmetries), key=lambda ids: off(board, found.uv[ids])[1])
    scale, worst = off(board, found.uv[order])
    assert scale == pytest.approx(1.0, abs=PAPER_MM / np.ptp(1e3 * board.body.points, axis=0).max())
    assert worst < PAPER_MM


def off(board, uv):
    """Scale of what was found on paper and its largest distance from the board, mm; Kalibr's boards have y up."""
    p, q = 1e3 * board.body.points[:, :2] @ [1, 1j], uv / PX_PER_MM @ [1, 1j]
    p = p.conj() if board.body.name.startswith("aprilgrid") else p
    (scale, shift), *_ = np.linalg.lstsq(np.stack([p, np.ones_like(p)], axis=1), q)
    return abs(scale), np.abs(scale * p + shift - q).max()


def cut_at(image, axis):
    """Where the marks in the margins of a sheet are, along an axis, px; the same on both sides."""
    margin = round(9.5 * PX_PER_MM), round(2 * PX_PER_MM)
    strips = (image[margin[1] : margin[0]], image[-margin[0] : -margin[1]])
    if axis == 0:
        strips = (image[:, margin[1] : margin[0]].T, image[:, -margin[0] : -margin[1]].T)
    # A mark is 4.5 mm long; the letters of a sheet's label are half of that.
    found = [np.flatnonzero((strip < 200).sum(axis=0) > 4 * PX_PER_MM) for strip in strips]
    np.testing.assert_array_equal(*found)
    groups = np.split(found[0], np.flatnonzero(np.diff(found[0]) > 3) + 1) if len(found[0]) else []
    return [float(group.mean()) for group in groups]


def test_sheets_cut_at_their_marks_make_the_whole_board(armsight, tmp_path):
    spec = "chessboard:5x4:45mm"  # 270 x 225 mm: two sheets of A4, or a page of A3
    sheets = pages_of(armsight, spec, tmp_path, "--split")
    assert len(sheets) == 2
    assert {sheet.shape for sheet in sheets} == {sheets[0].shape}
    axis = 1 if cut_at(sheets[0], 1) else 0
    first, last = (sheet if axis == 1 else sheet.T for sheet in sheets)
    (end,), (start,) = cut_at(sheets[0], axis), cut_at(sheets[1], axis)
    joined = np.hstack([first[:, : round(end)], last[:, round(start) :]])
    image = joined if axis == 1 else joined.T
    found = open_board(spec).detect(cv2.GaussianBlur(image, (0, 0), 0.8))
    assert len(found.ids) == 20, found.problem
    scale, worst = off(open_board(spec), found.uv)
    # Where the sheets are joined a pixel is rounded away or not, on top of what the paper allows.
    assert worst < PAPER_MM + 1 / PX_PER_MM
    assert scale == pytest.approx(1.0, abs=(PAPER_MM + 1 / PX_PER_MM) / 225)


def test_split_is_offered_where_a_drawing_is_too_large_and_changes_none_that_fits(armsight, tmp_path):
    said = armsight("body", "draw", "chessboard:9x6:50mm", "-o", tmp_path / "a.pdf")
    assert_rejected(said, "chessboard:9x6:50mm: the board needs", "--split", "--paper a2")
    said = armsight("body", "draw", "chessboard:9x6:50mm", "-o", tmp_path / "a.pdf", "--split").done()
    assert "page 1 is split over 6 sheets that overlap by 10 mm" in said.err
    assert (tmp_path / "a.pdf").read_bytes().count(b"/MediaBox") == 6
    assert armsight("body", "draw", PLATE, "-o", tmp_path / "b.pdf").code == 0
    assert armsight("body", "draw", PLATE, "-o", tmp_path / "c.pdf", "--split").code == 0
    assert (tmp_path / "b.pdf").read_bytes() == (tmp_path / "c.pdf").read_bytes()
    assert_rejected(armsight("body", "draw", "dartboard:3:4", "-o", tmp_path / "d.pdf"), "unknown board", "chessboard:")
    meant = armsight("body", "draw", "chesboard:9x6:20mm", "-o", tmp_path / "d.pdf")
    assert_rejected(meant, "unknown board 'chesboard:9x6:20mm'; did you mean chessboard:COLUMNSxROWS:SQUARE")
    assert "charuco" not in meant.err


def test_a_board_and_a_body_are_one_print(armsight, tmp_path):
    said = armsight("body", "draw", "chessboard:9x6:20mm", PLATE, "-o", tmp_path / "print.svg", "--json").done()
    assert [page["markers"][0] for page in answer(said)["pages"]] == ["chessboard:9x6:20mm", "P1"]
    assert len(answer(said)["files"]) == 2


@pytest.mark.parametrize(
    ("spec", "fits"),
    [
        ("chessboard:9x6:25mm", "chessboard:9x6:22mm"),
        ("charuco:11x8:30mm:22mm:DICT_5X5_100", "charuco:11x8:20mm:14.7mm:DICT_5X5_100"),
        ("circles:11x9:30mm", "circles:11x9:18mm"),
    ],
)
def test_a_board_that_is_too_large_gets_the_largest_that_fits(armsight, tmp_path, spec, fits):
    out = tmp_path / "board.pdf"
    assert_rejected(armsight("body", "draw", spec, "-o", out), f"take {fits}, the largest that fits")
    assert armsight("body", "draw", fits, "-o", out).code == 0
