"""Video files: real AVI files, written by OpenCV with a frame number in the grey of each frame."""

import math
import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from armsight.errors import InputError
from armsight.vision.sources import notes_of, open_source
from armsight.vision.sources.video import Film
from asserts import one_line


@pytest.fixture
def film(tmp_path):
    """Write a Motion-JPEG AVI of the given images."""

    def write(name, images, fps=30.0):
        path = tmp_path / name
        height, width = images[0].shape[:2]
        writer = cv2.VideoWriter(str(path), cv2.CAP_OPENCV_MJPEG, cv2.VideoWriter.fourcc(*"MJPG"), fps, (width, height))
        if not writer.isOpened():
            pytest.skip("this OpenCV cannot write Motion-JPEG AVI files")
        for image in images:
            writer.write(image)
        writer.release()
        return path

    return write


def shots(spec):
    source = open_source(spec)
    found = list(iter(source.read, None))
    source.close()
    source.close()
    assert source.read() is None
    return found


def test_two_files_frame_by_frame_with_the_files_times(film, picture, read_back):
    left, right = (film(f"{side}.avi", [picture(side, k) for k in range(12)]) for side in ("left", "right"))
    found = shots(f"video:{left},{right}")
    assert [(read_back(shot.left), read_back(shot.right)) for shot in found] == [
        (("left", k), ("right", k)) for k in range(12)
    ]
    assert [shot.t_s for shot in found] == pytest.approx([k / 30 for k in range(12)], abs=1e-6)
    assert [shot.name for shot in found[:2]] == ["000000", "000001"]


def test_unequal_lengths_stop_at_the_shorter_and_say_so(film, picture):
    left = film("left.avi", [picture("left", k) for k in range(9)])
    right = film("right.avi", [picture("right", k) for k in range(7)])
    found = shots(f"video:{left},{right}")
    assert [shot.problem is None for shot in found] == [True] * 7 + [False]
    assert found[-1].problem == f"{right} ends after 7 frames, {left} goes on: stopped there"


def test_frames_are_paired_by_time_and_those_without_a_partner_named(film, picture, read_back):
    left = film("left.avi", [picture("left", k) for k in range(10)], fps=30)
    right = film("right.avi", [picture("right", k) for k in range(5)], fps=15)
    found = shots(f"video:{left},{right}")
    pairs = [(read_back(shot.left)[1], read_back(shot.right)[1]) for shot in found if shot.problem is None]
    assert pairs == [(2 * k, k) for k in range(5)]
    alone = [shot for shot in found if shot.problem]
    assert alone[0].problem == f"{right} has no frame for {left}'s at 0.033 s: its next is at 0.067 s"
    assert alone[0].t_s == pytest.approx(1 / 30)


def test_files_of_different_rates_are_said(film, picture):
    images = [picture("left", k) for k in range(4)]
    left, slower, same = (film(f"{k}.avi", images, fps) for k, fps in enumerate((30, 25, 30)))
    (note,) = notes_of(open_source(f"video:{left},{slower}"))
    assert note.startswith(f"{left} has 30 frames a second and {slower} 25:")
    assert notes_of(open_source(f"video:{left},{same}")) == ()


def test_a_side_by_side_file_is_split_in_the_middle(film, picture, read_back):
    images = [np.hstack([picture("left", k), picture("right", k)]) for k in range(5)]
    found = shots(f"video:{film('both.avi', images)}")
    assert [(read_back(shot.left), read_back(shot.right)) for shot in found] == [
        (("left", k), ("right", k)) for k in range(5)
    ]
    assert found[0].left.shape == found[0].right.shape == (48, 64, 3)
    assert notes_of(open_source(f"video:{film('both.avi', images)}")) == ()
    one = film("one.avi", [np.zeros((48, 64, 3), np.uint8)] * 3)
    (note,) = notes_of(open_source(f"video:{one}"))
    assert note.startswith(f"{one}: frames of 64x48 px have the shape of one picture, and are taken as two of 32x48")


def test_a_file_that_is_cut_short_says_so(film, picture):
    rng = np.random.default_rng(7)
    noise = [rng.integers(0, 256, (96, 128, 3), dtype=np.uint8) for _ in range(20)]
    path = film("both.avi", noise)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    found = shots(f"video:{path}")
    assert 5 <= len(found) < 20
    assert found[-1].problem == f"{path} is damaged or cut short: it ends at {(len(found) - 1) / 30:.3f} s of 0.667 s"


def recorded(path, codec, kept, late=0, ticks=1, sound_s=0.0, live=False, right=0):
    """Write frames of 30 a second, each of which has its number as its grey level, without those that are not kept.

    With ticks a frame the numbers need not be whole; the right half is brighter by ``right``.
    A live file is Matroska without a duration.
    """
    opened = {"format": "matroska", "options": {"live": "1"}} if live else {}
    with av.open(str(path), "w", **opened) as file:
        stream = file.add_stream(codec, rate=30, bit_rate=1_000_000)
        sound = file.add_stream("aac", rate=48000) if sound_s else None
        stream.height, stream.width, stream.pix_fmt = 64, 128, "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.time_base = Fraction(1, 30 * ticks)
        for k in kept:
            grey = np.full((64, 128, 3), 5 * round(k) % 255, np.uint8)
            grey[:, 64:] += right
            frame = av.VideoFrame.from_ndarray(grey, format="bgr24")
            frame.pts, frame.time_base = round(k * ticks) + late, stream.codec_context.time_base
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
        for k in range(round(sound_s * 48000) // 1024):
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            silence.sample_rate, silence.pts, silence.time_base = 48000, 1024 * k, Fraction(1, 48000)
            file.mux(sound.encode(silence))
        if sound:
            file.mux(sound.encode(None))


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts", "avi"])
def test_sound_that_lasts_longer_than_the_images_is_no_damage(tmp_path, suffix):
    path = tmp_path / f"both.{suffix}"
    recorded(path, "libx264", range(20), sound_s=1.0)
    assert [shot.problem for shot in shots(f"video:{path}")] == [None] * 20


def test_matroska_with_sound_that_is_cut_short_says_so(tmp_path):
    path = tmp_path / "both.mkv"
    recorded(path, "libx264", range(60), sound_s=3.0)
    path.write_bytes(path.read_bytes()[:1500])
    assert "is damaged or cut short: it ends at" in shots(f"video:{path}")[-1].problem


def test_files_of_one_clock_without_a_duration_are_paired(tmp_path):
    paths = [tmp_path / "left.mkv", tmp_path / "right.mkv"]
    for path, first in zip(paths, (3, 10), strict=True):
        recorded(path, "libx264", range(first, first + 20), live=True)
    assert Film(str(paths[0])).promised_s == 0
    both = [shot for shot in shots(f"video:{paths[0]},{paths[1]}") if shot.problem is None]
    assert [[math.ceil(image.mean() / 5) for image in (shot.left, shot.right)] for shot in both] == [
        [k, k] for k in range(10, 23)
    ]


@pytest.mark.parametrize("suffix", ["mkv", "ts"])
def test_two_files_of_one_clock_need_not_begin_at_the_same_moment(tmp_path, suffix):
    left, right, past = (tmp_path / f"{name}.{suffix}" for name in ("left", "right", "past"))
    for path, first in ((left, 3), (right, 10), (past, 900)):
        recorded(path, "libx264", range(first, first + 20))  # frame k was recorded at k / 30 s, whatever the file
    for one, other in ((left, right), (right, left)):
        source = open_source(f"video:{one},{other}")
        (note,) = notes_of(source)
        assert note.startswith(f"{right} begins 0.233 s after {left} by their stamps")
        found = list(iter(source.read, None))
        both = [shot for shot in found if shot.problem is None]
        greys = [[math.ceil(image.mean() / 5) for image in (shot.left, shot.right)] for shot in both]
        assert greys == [[k, k] for k in range(10, 23)]
        np.testing.assert_allclose([shot.t_s for shot in both], np.arange(7, 20) / 30, atol=1.1e-3)
        assert f"{right} has no frame for {left}'s at 0.000 s" in found[0].problem
    source = open_source(f"video:{left},{past}")
    assert ", past its end: " in notes_of(source)[0]
    assert sum(shot.problem is None for shot in iter(source.read, None)) == 20


@pytest.mark.parametrize("reordered", [0, 1])
def test_transport_streams_of_one_moment_are_paired_where_one_alone_has_its_frames_reordered(tmp_path, reordered):
    """FFmpeg's muxer writes no times below 0: a file whose first frame is decoded two before begins two frames later."""
    files = [tmp_path / "left.ts", tmp_path / "right.ts"]
    for k, path in enumerate(files):
        recorded(path, "libx264" if k == reordered else "mpeg4", range(20))
    begins = [Film(str(path)).begin_s for path in files]
    assert begins[reordered] - begins[1 - reordered] == pytest.approx(2 / 30, abs=1e-3)
    source = open_source(f"video:{files[0]},{files[1]}")
    assert [note.partition(" as its")[0] for note in notes_of(source)] == [
        f"{files[reordered]} begins 0.067 s after {files[1 - reordered]}"
    ]
    greys = [[image.mean() / 5 for image in (shot.left, shot.right)] for shot in iter(source.read, None)]
    np.testing.assert_allclose(
        greys, np.repeat(np.arange(20.0)[:, None], 2, axis=1), atol=1.5
    )  # a shift is 2, rounding by codecs 1.1


def test_frames_that_an_edit_list_hides_are_no_damage(tmp_path):
    whole, cut = tmp_path / "whole.mp4", tmp_path / "cut.mp4"
    recorded(whole, "libx264", range(20))
    data = whole.read_bytes()
    at = data.index(b"elst") + 12  # one edit: its duration, ms, and where it begins in the track
    head, scale = data.index(b"mvhd") + 20, struct.unpack_from(">I", data, data.index(b"mdhd") + 16)[0]
    duration, begin = struct.unpack_from(">Ii", data, at)
    assert abs(struct.unpack_from(">I", data, head)[0] - duration) < 2
    left = struct.pack(">I", duration - round(1e3 * 8 / 30))
    data = data[:at] + left + struct.pack(">i", begin + 8 * scale // 30) + data[at + 8 :]
    cut.write_bytes(data[:head] + left + data[head + 4 :])
    found = shots(f"video:{cut}")
    assert [shot.problem for shot in found] == [None] * 12
    assert [math.ceil(shot.left.mean() / 5) for shot in found] == list(range(8, 20))


@pytest.mark.parametrize(
    ("name", "codec", "late"),
    [("a.avi", "mjpeg", 0), ("a.mkv", "libx264", 0), ("a.mkv", "libx264", 150), ("a.mp4", "libx264", 0)],
)
def test_frames_that_the_recorder_dropped_are_no_damage(tmp_path, name, codec, late):
    path, kept = tmp_path / name, [0, 1, 2, 3, 4, 7, 8, 12, 13, 14, 20]
    recorded(path, codec, kept, late)
    found = shots(f"video:{path}")
    assert [shot.problem for shot in found] == [None] * len(kept)
    assert [shot.t_s for shot in found] == pytest.approx([k / 30 for k in kept], abs=1e-3)


@pytest.mark.parametrize(("suffix", "codec"), [("avi", "mjpeg"), ("mkv", "libx264"), ("mp4", "libx264")])
def test_frames_are_not_paired_across_those_that_were_dropped(tmp_path, suffix, codec):
    kept = [[0, 1, 2, 3, 4, 5, 6, 30, 31, 33, 50], [0, 2, 3, 5, 6, 30, 32, 33, 50]]  # the mean rate is far below 30
    left, right = (tmp_path / f"{side}.{suffix}" for side in ("left", "right"))
    for path, numbers in zip((left, right), kept, strict=True):
        recorded(path, codec, numbers)
    found = shots(f"video:{left},{right}")
    both = [shot for shot in found if shot.problem is None]
    assert [shot.t_s for shot in both] == pytest.approx([k / 30 for k in sorted(set(kept[0]) & set(kept[1]))], abs=1e-3)
    assert all(abs(float(shot.left.mean()) - float(shot.right.mean())) < 2.5 for shot in both)


def test_stamps_that_jitter_are_paired_up_to_half_a_frame_apart(tmp_path):
    number = np.arange(300)
    stamps = number + np.random.default_rng(11).normal(0, 0.12, (2, 300)) * (number > 0)
    left, right = (tmp_path / f"{side}.mkv" for side in ("left", "right"))
    for path, kept in zip((left, right), stamps, strict=True):
        recorded(path, "libx264", kept, ticks=100)
    both = [shot for shot in shots(f"video:{left},{right}") if shot.problem is None]
    assert all(abs(float(shot.left.mean()) - float(shot.right.mean())) < 2.5 for shot in both)
    assert len(both) == pytest.approx(np.sum(np.abs(np.diff(stamps, axis=0)) < 0.5), abs=2)


@pytest.mark.parametrize("codec", ["libsvtav1", "libx264", "mpeg4", "libvpx-vp9", "mjpeg"])
def test_what_cameras_and_datasets_write_is_read(tmp_path, codec):
    path = tmp_path / "both.mkv"
    recorded(path, codec, range(0, 24, 2), right=5)
    found = shots(f"video:{path}")
    assert [shot.problem for shot in found] == [None] * 12
    assert [shot.t_s for shot in found] == pytest.approx([k / 15 for k in range(12)], abs=1e-3)
    greys = [[np.mean(image) for image in (shot.left, shot.right)] for shot in found]
    np.testing.assert_allclose(greys, [[10 * k, 10 * k + 5] for k in range(12)], atol=4)


def test_a_file_that_names_others_is_no_video(film, picture, tmp_path):
    good = film("good.avi", [picture("left", 1)])
    playlist = tmp_path / "list.mp4"
    playlist.write_text("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n")
    with pytest.raises(InputError, match="not a video file"):
        open_source(f"video:{playlist},{good}")


def test_damaged_frames_are_counted_and_the_rest_read(film):
    rng = np.random.default_rng(7)
    path = film("both.avi", [rng.integers(0, 256, (96, 128, 3), dtype=np.uint8) for _ in range(20)])
    data = bytearray(path.read_bytes())
    at = [k for k in range(len(data) - 1) if data[k : k + 2] == b"\xff\xd8"]
    data[at[5] : at[6] - 8] = bytes(at[6] - 8 - at[5])
    path.write_bytes(data)
    source = open_source(f"video:{path}")
    found = list(iter(source.read, None))
    assert sum(shot.problem is None for shot in found) == 19
    assert f"{path}: 1 frames are damaged: left out" in notes_of(source)


def test_what_is_no_video_is_named(film, picture, tmp_path, capfd):
    odd = film("odd.avi", [picture("left", 1, (65, 48))])
    good = film("good.avi", [picture("left", 1)])
    text = tmp_path / "text.mp4"
    text.write_text("hello")
    for spec, said in (
        (f"video:{odd}", f"{odd}: a side-by-side video must have an even width, this one is 65 px wide"),
        (f"video:{good},{tmp_path}/none.avi", f"{tmp_path}/none.avi: no such file"),
        (f"video:{text}", f"{text}: not a video file, or one that is cut short at its beginning"),
        (f"video:{good},{good}", f"{good}: given as both left and right video"),
        (f"video:{good},{good},{good}", "expected video:LEFT.mp4,RIGHT.mp4 or video:SIDE_BY_SIDE.mp4"),
        ("video:", "expected video:LEFT.mp4,RIGHT.mp4"),
    ):
        with one_line(said):
            open_source(spec)
    assert capfd.readouterr().err == ""


def moving(k, rng, at_rest=False):
    """A square that moves by 3 px a frame before noise, or rests."""
    image = np.full((96, 160, 3), 60, np.uint8)
    left = 10 + 3 * (0 if at_rest else k)
    covered = np.clip(np.arange(160) + 1 - left, 0, 1) * np.clip(left + 30 - np.arange(160), 0, 1)
    image[30:60] = 60 + 130 * covered[:, None]
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("times", "share", "rate"), [(2, 50, 15), (3, 67, 10)])
def test_frames_that_repeat_are_said_although_encoded_again(film, times, share, rate):
    rng = np.random.default_rng(1)
    repeated = [
        np.clip(image + rng.normal(0, 0.5, image.shape), 0, 255).astype(np.uint8)
        for k in range(36 // times)
        for image in [moving(k, rng)] * times
    ]
    left, right = film("left.avi", repeated), film("right.avi", [moving(k, rng) for k in range(36)])
    source = open_source(f"video:{left},{right}")
    assert notes_of(source) == ()
    list(iter(source.read, None))
    (note,) = notes_of(source)
    assert note.startswith(f"{left}: ")
    assert int(note.split(" % of the frames repeat")[0].split()[-1]) == pytest.approx(share, abs=4)
    assert int(note.split(" images a second and the file has 30;")[0].split()[-1]) == pytest.approx(rate, abs=1)


def test_what_moves_stops_and_rests_repeats_no_frames(film):
    rng = np.random.default_rng(2)
    stopping = [moving(k - 6 if k > 6 else 0, rng) if k < 18 else moving(12, rng) for k in range(36)]
    swinging = [moving(12 + 12 * np.sin(k / 5), rng) for k in range(36)]
    resting = [moving(0, rng, at_rest=True) for _ in range(36)]
    for name, images in (("stops", stopping), ("swings", swinging), ("rests", resting)):
        source = open_source(f"video:{film(f'{name}-left.avi', images)},{film(f'{name}-right.avi', images)}")
        list(iter(source.read, None))
        assert notes_of(source) == (), name


@pytest.mark.parametrize(("rates", "share"), [((15, 30), 50), ((10, 30), 67)])
def test_interpolated_frames_are_said(film, rates, share):
    rng = np.random.default_rng(3)
    own = [moving(k, rng).astype(float) for k in range(38)]
    converted = []
    for k in range(36):
        at = k * rates[0] / rates[1]
        converted.append(((1 - at % 1) * own[int(at)] + at % 1 * own[int(at) + 1]).astype(np.uint8))
    left, right = film("left.avi", converted), film("right.avi", [moving(k, rng) for k in range(36)])
    source = open_source(f"video:{left},{right}")
    list(iter(source.read, None))
    (note,) = notes_of(source)
    assert note.startswith(f"{left}: ")
    assert int(note.split(" % of the frames are interpolated")[0].split()[-1]) == pytest.approx(share, abs=8)
    ((path, odd),) = source.odd_frames.items()
    assert path == str(left)
    assert {k * rates[0] % rates[1] != 0 for k in odd["interpolated"]} == {True}
    assert f"frames {odd['interpolated'][0]}, {odd['interpolated'][1]}, " in note


@pytest.mark.opencv
@pytest.mark.parametrize(
    ("matrix", "shown", "as_opencv"),
    [
        ((1, 0, 0, 1), lambda a: a, True),
        ((0, 1, -1, 0), lambda a: np.rot90(a, -1), True),
        ((-1, 0, 0, -1), lambda a: np.rot90(a, 2), True),
        ((0, -1, 1, 0), np.rot90, True),
        ((-1, 0, 0, 1), np.fliplr, False),
        ((1, 0, 0, -1), np.flipud, False),
        ((0, 1, 1, 0), lambda a: a.transpose(1, 0, 2), False),
        ((0, -1, -1, 0), lambda a: np.rot90(a, 2).transpose(1, 0, 2), False),
    ],
)
def test_a_rotation_or_mirroring_that_was_noted_is_applied(tmp_path, matrix, shown, as_opencv):
    stored = np.kron(np.random.default_rng(1).integers(0, 255, (6, 8, 3), np.uint8), np.ones((12, 12, 1), np.uint8))
    path = tmp_path / "phone.mp4"
    with av.open(str(path), "w") as file:
        stream = file.add_stream("mpeg4", rate=30)
        stream.height, stream.width = stored.shape[:2]
        for _ in range(3):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(stored, format="bgr24")))
        file.mux(stream.encode())
    with av.open(str(path)) as file:
        plain = next(file.decode(video=0)).to_ndarray(format="bgr24")
    a, b, c, d = (65536 * each for each in matrix)
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44  # ISO 14496-12, 8.3.2, version 0
    data[at : at + 36] = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], ">i4").tobytes()
    path.write_bytes(data)
    film = Film(str(path))
    expected = shown(plain)
    assert film.size_px == expected.shape[1::-1]
    assert film.next()
    assert film.frames == 1
    np.testing.assert_array_equal(film.image(), expected)
    if as_opencv:
        np.testing.assert_allclose(film.image().astype(int), cv2.VideoCapture(str(path)).read()[1], atol=3)
    assert [film.next() for _ in range(3)] == [True, True, False]
    film.close()
