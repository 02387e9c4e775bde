"""Reading image files: what is whole is read as stored, what is damaged is rejected with the file's name."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from armsight.app.record.recording import record
from armsight.errors import InputError
from armsight.vision.blinking import WINDOW, window
from armsight.vision.image import BitDepth, grey, read_image
from armsight.vision.sources import FolderSource

RNG = np.random.default_rng(0)
GREY = RNG.integers(0, 256, (40, 60), dtype=np.uint8)
COLOUR = cv2.resize(RNG.integers(0, 256, (10, 15, 3), dtype=np.uint8), (60, 40))


def stored(tmp_path, name, image):
    path = tmp_path / name
    assert cv2.imwrite(str(path), image)
    return path


@pytest.mark.opencv
@pytest.mark.parametrize("suffix", ["png", "bmp", "tif", "pgm"])
def test_grey_comes_back_as_it_was(tmp_path, suffix):
    np.testing.assert_array_equal(read_image(stored(tmp_path, f"a.{suffix}", GREY)), GREY)


@pytest.mark.opencv
def test_sixteen_bits_and_colour_come_back_as_they_were(tmp_path):
    deep = GREY.astype(np.uint16) * 257
    np.testing.assert_array_equal(read_image(stored(tmp_path, "a.png", deep)), deep)
    np.testing.assert_array_equal(read_image(stored(tmp_path, "b.png", COLOUR)), COLOUR)
    alpha = np.dstack([COLOUR, np.full((40, 60), 9, np.uint8)])
    np.testing.assert_array_equal(read_image(stored(tmp_path, "c.png", alpha)), COLOUR)


@pytest.mark.opencv
@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
def test_a_truncated_file_is_rejected(tmp_path, suffix, share, capfd):
    path = stored(tmp_path, f"a.{suffix}", COLOUR)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match=rf"a\.{suffix}.*truncated"):
        read_image(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("padding", [b"\x00" * 5000, b"\r\n", b"camera maker's notes" * 400])
def test_padding_after_the_end_is_tolerated(tmp_path, suffix, padding):
    path = stored(tmp_path, f"a.{suffix}", COLOUR)
    whole = read_image(path)
    path.write_bytes(path.read_bytes() + padding)
    np.testing.assert_array_equal(read_image(path), whole)


def with_exif(jpeg, orientation, thumbnail=b""):
    """Put an EXIF segment with an orientation, and a thumbnail behind it, into JPEG data."""
    tiff = b"II*\x00" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, orientation, 0)
    body = b"Exif\x00\x00" + tiff + thumbnail
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


@pytest.mark.opencv
def test_exif_orientation_is_ignored(tmp_path):
    path = stored(tmp_path, "a.jpg", COLOUR)
    plain = read_image(path)
    path.write_bytes(with_exif(path.read_bytes(), 6))
    np.testing.assert_array_equal(read_image(path), plain)


def with_orientation(tiff, orientation):
    """Give a little-endian TIFF the orientation: a copy of its first directory with the tag, at the end."""
    (at,) = struct.unpack_from("<I", tiff, 4)
    (count,) = struct.unpack_from("<H", tiff, at)
    entries = [tiff[at + 2 + 12 * k :][:12] for k in range(count)]
    entries = [one for one in entries if one[:2] != struct.pack("<H", 274)]
    entries.append(struct.pack("<HHIHH", 274, 3, 1, orientation, 0))
    directory = struct.pack("<H", len(entries)) + b"".join(
        sorted(entries, key=lambda one: struct.unpack("<H", one[:2]))
    )
    return tiff[:4] + struct.pack("<I", len(tiff)) + tiff[8:] + directory + bytes(4)


@pytest.mark.opencv
@pytest.mark.parametrize("image", [GREY, COLOUR])
@pytest.mark.parametrize(
    ("orientation", "shown"),
    [(1, lambda a: a), (3, lambda a: a), (6, lambda a: a), (8, lambda a: a), (2, np.fliplr), (4, np.flipud)],
)
def test_a_tiffs_rotation_is_ignored_and_its_mirrored_rows_are_put_right(
    tmp_path, image, orientation, shown, monkeypatch
):
    path = stored(tmp_path, "a.tiff", image)
    path.write_bytes(with_orientation(path.read_bytes(), orientation))
    np.testing.assert_array_equal(read_image(path), shown(image))
    monkeypatch.setattr("armsight.vision.image.IMAGE_MB", 1e-6)  # as a large file is read
    if orientation in (6, 8):  # which OpenCV's imread, unlike imdecode, does not read
        with pytest.raises(InputError, match="not an image that can be read"):
            read_image(path)
    else:
        np.testing.assert_array_equal(read_image(path), shown(image))


@pytest.mark.parametrize("at", [1 << 62, 1 << 63, (1 << 64) - 1])
def test_a_big_tiff_whose_directory_is_nowhere_is_rejected(tmp_path, at, monkeypatch):
    path = tmp_path / "a.tiff"
    path.write_bytes(struct.pack("<2s3HQ", b"II", 43, 8, 0, at))
    for most_mb in (128, 1e-6):  # whole, and as a large file is read
        monkeypatch.setattr("armsight.vision.image.IMAGE_MB", most_mb)
        with pytest.raises(InputError, match=r"a\.tiff: not an image that can be read"):
            read_image(path)


def test_a_thumbnail_end_is_not_the_end(tmp_path):
    path = stored(tmp_path, "a.jpg", COLOUR)
    data = with_exif(path.read_bytes(), 1, thumbnail=path.read_bytes())
    path.write_bytes(data[:-300])
    with pytest.raises(InputError, match="truncated"):
        read_image(path)


@pytest.mark.parametrize("data", [b"", b"shot,camera,marker\n", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_image_is_rejected(tmp_path, data):
    path = tmp_path / "a.png"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.png: "):
        read_image(path)


@pytest.mark.opencv
def test_damaged_png_data_is_rejected(tmp_path, capfd):
    chunk = b"IDAT" + b"not deflated"
    path = tmp_path / "a.png"
    data = stored(tmp_path, "b.png", GREY).read_bytes()
    idat = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    path.write_bytes(data[:33] + idat + data[-12:])
    with pytest.raises(InputError, match=r"a\.png"):
        read_image(path)
    assert capfd.readouterr().err == ""


def test_missing_files_and_folders_are_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.png: no such file"):
        read_image(tmp_path / "none.png")
    with pytest.raises(InputError, match="cannot be read"):
        read_image(tmp_path)


def test_grey_of_every_kind_of_image():
    np.testing.assert_array_equal(grey(GREY), GREY)
    np.testing.assert_array_equal(grey(GREY[:, :, None]), GREY)
    np.testing.assert_array_equal(grey(GREY.astype(np.uint16) * 257), GREY)
    deep = np.arange(1 << 16, dtype=np.uint16)[None]
    np.testing.assert_array_equal(grey(deep), np.rint(deep / 257))
    np.testing.assert_array_equal(grey(deep[:, :1000]), grey(deep)[:, :1000])  # a dark image is dark
    expected = cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)
    np.testing.assert_array_equal(grey(COLOUR), expected)
    np.testing.assert_array_equal(grey(np.dstack([COLOUR, GREY])), expected)
    assert np.abs(grey(COLOUR.astype(np.uint16) * 257).astype(int) - expected).max() <= 1
    assert grey(COLOUR[::2, ::2]).flags.c_contiguous
    for image in (GREY, GREY.astype(np.uint16), COLOUR):
        assert not grey(image).flags.writeable
    assert GREY.flags.writeable


def test_a_dark_window_of_a_deep_image_has_the_grey_levels_of_the_whole():
    deep = np.full((2 * WINDOW, 2 * WINDOW), 900, np.uint16)
    deep[0, 0] = 4000
    assert set(np.unique(window(deep, (WINDOW, WINDOW)))) == {round(900 / 257)}


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_both_cameras_and_all_shots_of_a_source_have_one_depth(tmp_path, bits):
    full = (1 << bits) - 1
    for k, most in enumerate([full // 90, full // 30, full, full // 9]):
        for side, share in (("left", 1.0), ("right", 0.5)):
            image = np.rint(np.linspace(0, share * most, 256)).astype(np.uint16).reshape(16, 16)
            cv2.imwrite(str(tmp_path / f"{side}{k}.png"), image)
    source = FolderSource.open(tmp_path)
    raw = [(read_image(pair.left), read_image(pair.right)) for pair in source.pairs]
    part = list(source[1:2])
    for shot, images in zip([*source, *part], [*raw, raw[1]], strict=True):
        assert shot.bits == bits
        for now, came in zip((shot.left, shot.right), images, strict=True):
            np.testing.assert_allclose(grey(now), came * (255 / full), atol=0.75)
    assert len(source.notes) == (bits != 16)
    record(FolderSource.open(tmp_path), tmp_path / "again")  # keeps what came
    for k, images in enumerate(raw):
        for side, came in zip(("left", "right"), images, strict=True):
            np.testing.assert_array_equal(read_image(tmp_path / "again" / f"{side}{k:06d}.png"), came)


def test_a_depth_never_falls_and_says_when_it_rises():
    depth, image = BitDepth(), np.full((4, 4), 1000, np.uint16)
    assert depth.filled(image)[0][0, 0] == 1000 << 6
    assert depth.filled(image * 4)[0][0, 0] == 1000 << 6
    assert depth.filled(image)[0][0, 0] == 1000 << 4
    assert [note.partition(",")[0][-7:] for note in depth.notes] == ["10 bits", "12 bits"]
    assert depth.filled(GREY)[0] is GREY


@pytest.mark.parametrize(
    "image", [GREY.astype(float), np.zeros((3, 4, 5), np.uint8), np.zeros((0, 4), np.uint8), GREY[0]]
)
def test_grey_of_anything_else_is_rejected(image):
    with pytest.raises(InputError, match="image"):
        grey(image)
