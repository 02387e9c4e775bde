"""Pairs of image files by two globs, and folders of them."""

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armsight.data import Shot
from armsight.errors import InputError
from armsight.files import natural_key
from armsight.vision.source import PlayedSource
from armsight.vision.sources import FolderSource, PairsSource, open_source
from armsight.vision.sources.pairs import match


def shots(source):
    found = []
    while (shot := source.read()) is not None:
        found.append(shot)
    source.close()
    assert source.read() is None
    return found


@pytest.mark.opencv
def test_pairs_go_by_number_and_are_called_after_the_left_file(tmp_path, store, read_back):
    for k in (1, 2, 10):
        store(tmp_path / f"left{k}.png", "left", k)
        store(tmp_path / f"right{k}.png", "right", k)
    source = PairsSource.open(f"{tmp_path}/left*.png", f"{tmp_path}/right*.png")
    assert source.count == 3
    assert set(source.files) == set(tmp_path.iterdir())
    found = shots(source)
    assert [shot.name for shot in found] == ["left1", "left2", "left10"]
    assert [(read_back(shot.left), read_back(shot.right)) for shot in found] == [
        (("left", k), ("right", k)) for k in (1, 2, 10)
    ]
    assert all(shot.t_s is None and shot.problem is None for shot in found)


@pytest.mark.parametrize(("left", "right"), [("a,b", "c"), ("c", "a,b"), ("a,b", "a,c"), ("a,b,c", "d")])
def test_a_folder_may_have_a_comma_in_its_name(tmp_path, store, left, right):
    for side, folder in (("left", left), ("right", right)):
        (tmp_path / folder).mkdir()
        store(tmp_path / folder / f"{side}1.png", side, 1)
    found = shots(open_source(f"pairs:{tmp_path}/{left}/left*.png,{tmp_path}/{right}/right*.png"))
    assert [shot.problem for shot in found] == [None]


@pytest.mark.opencv
def test_a_damaged_image_is_a_shot_with_a_problem_and_the_run_goes_on(tmp_path, store):
    for k in range(3):
        store(tmp_path / f"left{k}.png", "left", k)
        store(tmp_path / f"right{k}.png", "right", k)
    whole = (tmp_path / "right1.png").read_bytes()
    (tmp_path / "right1.png").write_bytes(whole[: len(whole) // 2])
    found = shots(open_source(str(tmp_path)))
    assert [shot.problem is None for shot in found] == [True, False, True]
    assert "right1.png" in found[1].problem
    assert found[1].left is None
    assert found[1].right is None


def message(left, right):
    with pytest.raises(InputError) as caught:
        match([Path(name) for name in left], [Path(name) for name in right], "L*", "R*")
    return str(caught.value)


@pytest.mark.parametrize(
    ("left", "right", "said"),
    [
        ([], ["r1"], "L*: no such file"),
        (["l1"], [], "R*: no such file"),
        (["l1", "l2", "l3"], ["r1", "r3"], "3 left and 2 right images; first without a partner: l2"),
        (["l1", "l2"], ["r1", "r2", "r10", "r9"], "2 left and 4 right images; first without a partner: r9"),
        # Equal counts, but a hole on each side: order alone would pair l3 with r4 without a word.
        (["l1", "l3", "l4"], ["r1", "r4", "r5"], "3 left and 3 right images; first without a partner: l3"),
        (["la", "lb"], ["ra"], "2 left and 1 right images; first without a partner: lb"),
        (["a/1", "b/2"], ["b/2", "c/3"], "is both a left and a right image"),
    ],
)
def test_what_does_not_pair_up_is_an_error_that_names_it(left, right, said):
    assert said in message(left, right)


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (["cam0_8.png", "cam0_9.png", "cam0_10.png"], ["cam1_8.png", "cam1_9.png", "cam1_10.png"]),
        (["2024-01-05_1_cam0", "2024-01-05_2_cam0"], ["2024-01-05_1_cam1", "2024-01-05_2_cam1"]),
        (["l_1403636579763", "l_1403636579813"], ["r_1403636579764", "r_1403636579814"]),  # two clocks: by order
        (["left.png"], ["right.png"]),
        (["b_l", "a_l"], ["a_r", "b_r"]),
    ],
)
def test_names_that_differ_in_more_than_left_and_right_pair_up(left, right):
    pairs = match([Path(n) for n in left], [Path(n) for n in right], "L", "R")
    order = (
        [str(n) for n in sorted(map(Path, left), key=natural_key)],
        [str(n) for n in sorted(map(Path, right), key=natural_key)],
    )
    assert [(str(pair.left), str(pair.right)) for pair in pairs] == list(zip(*order, strict=True))


def test_names_stay_unique_where_stems_repeat():
    left, right = ([Path(f"/d/{side}/{run}/1.png") for run in "ab"] for side in ("l", "r"))
    assert [pair.name for pair in match(left, right, "L", "R")] == ["a/1.png", "b/1.png"]


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=20, unique=True), st.randoms())
def test_numbers_sort_as_numbers_whatever_their_padding(numbers, random):
    names = [Path(f"x{n:0{random.randint(1, 8)}d}_l.png") for n in numbers]
    random.shuffle(names)
    assert [int(p.stem[1:-2]) for p in sorted(names, key=natural_key)] == sorted(numbers)


@given(st.sets(st.integers(0, 99), min_size=3, max_size=20), st.data())
def test_a_hole_on_one_side_is_always_named(numbers, data):
    gone = data.draw(st.sampled_from(sorted(numbers)))
    left = [f"left{n}.png" for n in numbers]
    right = [f"right{n}.png" for n in numbers - {gone}]
    assert message(left, right).endswith(f"first without a partner: left{gone}.png")
    assert message(right, left).endswith(f"first without a partner: left{gone}.png")


def test_a_glob_that_matches_nothing_or_a_folder_says_so(tmp_path):
    with pytest.raises(InputError, match=r"nothing\*.png: no such file"):
        PairsSource.open(f"{tmp_path}/nothing*.png", f"{tmp_path}/*")
    with pytest.raises(InputError, match="is a folder; give its images"):
        PairsSource.open(str(tmp_path), str(tmp_path))
    (tmp_path / "IMG_1.JPG").touch()
    with pytest.raises(InputError, match=r"nothing\*.png: no such file; the images there are '.*/\*.JPG'"):
        PairsSource.open(f"{tmp_path}/nothing*.png", f"{tmp_path}/*")


def test_a_folder_with_left_and_right_subfolders(tmp_path, store, read_back):
    for k in (2, 10):
        store(tmp_path / "left" / f"{k}.png", "left", k)
        store(tmp_path / "right" / f"{k}.png", "right", k)
    (tmp_path / "left" / "notes.txt").write_text("no image")
    found = shots(open_source(f"folder:{tmp_path}"))
    assert [(shot.name, read_back(shot.left)[1], read_back(shot.right)[1]) for shot in found] == [
        ("2", 2, 2),
        ("10", 10, 10),
    ]


def test_files_that_hold_both_images_side_by_side(tmp_path):
    for k in (2, 10):
        cv2.imwrite(str(tmp_path / f"S {k}.png"), np.repeat(np.uint8([[k, k + 1]]), 40, axis=1).repeat(30, axis=0))
    found = shots(open_source(str(tmp_path)))
    assert [(shot.name, shot.left.shape, int(shot.left.max()), int(shot.right.min())) for shot in found] == [
        ("S 2", (30, 40), 2, 3),
        ("S 10", (30, 40), 10, 11),
    ]
    cv2.imwrite(str(tmp_path / "S 1.png"), np.zeros((30, 40), np.uint8))
    with pytest.raises(
        InputError, match=r"S 1.png: is 40x30, which is not two images side by side; .* 'pairs:.*/LEFT\*.png,"
    ):
        FolderSource.open(tmp_path)


def test_a_folder_without_shots_or_none_at_all(tmp_path):
    with pytest.raises(InputError, match=r"holds no shots: expected shots.csv, images left\* and right\*"):
        FolderSource.open(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        open_source(f"folder:{tmp_path}/none")
    (tmp_path / "left1.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"right\*: no such file"):
        FolderSource.open(tmp_path)


HEADER = "shot,t_s,left,right,problem\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "line 1: expected the columns shot,t_s,left,right,problem"),
        ("a,b\n", "line 1: expected the columns"),
        (HEADER, "holds no shots"),
        (HEADER + "1,0.5,l,r\n", "line 2: expected 5 fields, found 4"),
        (HEADER + "1,0.5,l,r,\n2,abc,l,r,\n", "line 3: t_s must be a number of seconds or empty, got 'abc'"),
        (HEADER + "1,nan,l,r,\n", "line 2: t_s must be finite"),
        (HEADER + "1,,l,r,\n1,,l,r,\n", "line 3: shot '1' a second time"),
        (HEADER + "1,,l,,\n", "line 2: shot '1' has no images and no reason why"),
        (HEADER + "1,,l,r," + "x" * 200_000, "field larger than field limit"),
    ],
)
def test_a_damaged_index_is_named_with_its_line(tmp_path, text, said):
    (tmp_path / "shots.csv").write_text(text)
    with pytest.raises(InputError, match=f"{tmp_path}/shots.csv: .*{said}"):
        FolderSource.open(tmp_path)


def test_an_index_is_followed(tmp_path, store, read_back):
    store(tmp_path / "b.png", "left", 3)
    store(tmp_path / "a.png", "right", 3)
    (tmp_path / "shots.csv").write_text(HEADER + "x,1.25,b.png,a.png,\ny,1.5,,,camera asleep\nz,,gone.png,a.png,\n")
    x, y, z = shots(FolderSource.open(tmp_path))
    assert (x.name, x.t_s, read_back(x.left), read_back(x.right)) == ("x", 1.25, ("left", 3), ("right", 3))
    assert (y.name, y.t_s, y.problem, y.left) == ("y", 1.5, "camera asleep", None)
    assert (z.t_s, z.problem) == (None, f"{tmp_path}/gone.png: no such file")


def test_a_file_or_an_address_without_its_kind_is_given_one():
    with pytest.raises(InputError, match=r"not a source \(url:LEFT,RIGHT\?\): known are"):
        open_source("http://a/b")
    with pytest.raises(InputError, match=r"not a source \(video:.*\.py\?\): known are"):
        open_source(__file__)


@pytest.mark.parametrize("spec", ["folder:", "folder::", "usb::", "usb::0,1", "bag: "])
def test_a_source_of_no_name_is_not_the_current_folder(spec):
    with pytest.raises(InputError, match=f"'{spec}': expected '{spec.partition(':')[0]}:' and then what it opens"):
        open_source(spec)


@pytest.mark.parametrize("spec", ["film:a.mp4", "/no/such/folder", "usbcam", ""])
def test_an_unknown_source_lists_the_known_ones(spec):
    with pytest.raises(InputError, match=r"not a source: known are folder:..., pairs:..., video:..., url:..., usb:..."):
        open_source(spec)


def test_a_shot_whose_reading_was_interrupted_is_read_by_the_next_call():
    interrupts = ["b"]

    def read(every):
        for name in "abcd"[::every]:
            if name in interrupts:
                interrupts.remove(name)
                raise KeyboardInterrupt
            yield Shot(name, None, None, None, "no image")

    source = PlayedSource(read, 4)
    assert source.read().name == "a"
    with pytest.raises(KeyboardInterrupt):
        source.read()
    assert [shot.name for shot in shots(source)] == ["b", "c", "d"]


def test_a_source_may_be_closed_while_another_thread_reads():
    reading, go_on, found, ended = threading.Event(), threading.Event(), [], []

    def read(every):
        try:
            reading.set()
            assert go_on.wait(60)
            yield from (Shot(name, None, None, None, "no image") for name in "ab")
        finally:
            ended.append(True)

    source = PlayedSource(read, 2)
    reader = threading.Thread(target=lambda: found.append(source.read()))
    reader.start()
    assert reading.wait(60)
    source.close()
    go_on.set()
    reader.join(60)
    assert [shot.name for shot in found] == ["a"]
    assert source.read() is None
    assert ended == [True]
