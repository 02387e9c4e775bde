"""LeRobot datasets of format 2 and 3: two cameras as shots, the joints, and what is missing in one line."""

import json

import av
import cv2
import numpy as np
import pytest

pytest.importorskip("pyarrow")

from armsight.errors import InputError
from armsight.vision.sources import notes_of, open_source
from armsight.vision.sources.lerobot import LeRobotDataset
from armsight.vision.sources.video import Film
from asserts import one_line

FPS, KEYS = 10, ("observation.images.left", "observation.images.right")


def video(path, levels):
    """An MP4 of AV1 as lerobot writes it, whose frames have one grey level each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as file:
        stream = file.add_stream(
            "libsvtav1", FPS, width=64, height=64, pix_fmt="yuv420p", options={"g": "2", "crf": "30"}
        )
        for level in levels:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((64, 64, 3), level, np.uint8), format="bgr24")))
        file.mux(stream.encode(None))


@pytest.fixture
def dataset(tmp_path):
    """Write a dataset of two episodes of five frames; the grey level says camera, episode and frame."""
    import pyarrow as pa
    from pyarrow import parquet

    def write(version):
        v3 = version.startswith("v3")
        template = (
            "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
            if v3
            else "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        )
        features = {key: {"dtype": "video", "shape": [48, 64, 3]} for key in KEYS}
        features["observation.state"] = {"dtype": "float32", "shape": [2], "names": ["shoulder", "elbow"]}
        info = {"codebase_version": version, "fps": FPS, "video_path": template, "features": features}
        (tmp_path / "meta").mkdir()
        (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
        rows = [(k / FPS, e, k, [0.1 * k, float(e)]) for e in range(2) for k in range(5)]
        names = ("timestamp", "episode_index", "frame_index", "observation.state")
        (tmp_path / "data" / "chunk-000").mkdir(parents=True)
        table = pa.table({name: [row[i] for row in rows] for i, name in enumerate(names)})
        parquet.write_table(table, tmp_path / "data" / "chunk-000" / "file-000.parquet")
        for c, key in enumerate(KEYS):
            levels = [[100 * c + 50 * e + 10 * k for k in range(5)] for e in range(2)]
            if v3:
                video(tmp_path / template.format(video_key=key, chunk_index=0, file_index=0), levels[0] + levels[1])
                continue
            for e in range(2):
                video(tmp_path / template.format(video_key=key, episode_chunk=0, episode_index=e), levels[e])
        if v3:
            columns = {"episode_index": [0, 1]}
            for key in KEYS:
                columns |= {f"videos/{key}/{part}_index": [0, 0] for part in ("chunk", "file")}
                columns[f"videos/{key}/from_timestamp"] = [0.0, 5 / FPS]
            (tmp_path / "meta" / "episodes").mkdir()
            parquet.write_table(pa.table(columns), tmp_path / "meta" / "episodes" / "file-000.parquet")
        return tmp_path

    return write


def described(folder, change):
    """Change a dataset's description."""
    path = folder / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def shots(folder, tail=""):
    return list(iter(open_source(f"lerobot:{folder}{tail}").read, None))


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_frames_of_every_episode_are_shots(dataset, version):
    folder = dataset(version)
    source = open_source(f"lerobot:{folder}")
    found = list(iter(source.read, None))
    assert source.count == len(found) == 10
    assert not notes_of(source)
    assert [shot.problem for shot in found] == [None] * 10
    for n, shot in enumerate(found):
        for c, image in enumerate((shot.left, shot.right)):
            assert abs(float(np.mean(image)) - (100 * c + 50 * (n // 5) + 10 * (n % 5))) < 4, (n, c)
    assert np.all(np.diff([shot.t_s for shot in found]) > 0)
    assert len(shots(folder, ",episode=1")) == 5
    joints = LeRobotDataset(folder).joints()
    assert joints.names == ("shoulder", "elbow")
    np.testing.assert_allclose(joints.values[7], [0.2, 1.0], atol=1e-7)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_images_that_stand_in_the_table_are_shots(dataset, version):
    import pyarrow as pa
    from pyarrow import parquet

    folder = dataset(version)
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    table = parquet.read_table(file)
    for c, key in enumerate(KEYS):
        images = [np.full((48, 64, 3), 100 * c + 10 * k, np.uint8) for k in range(10)]
        stored = [
            {"bytes": cv2.imencode(".png", image)[1].tobytes(), "path": f"frame_{k}.png"}
            for k, image in enumerate(images)
        ]
        stored[7] = {"bytes": None, "path": "frame_7.png"}
        table = table.append_column(key, pa.array(stored, pa.struct({"bytes": pa.binary(), "path": pa.string()})))
    half = [table.slice(0, 4), table.slice(4)]
    parquet.write_table(half[0], file)
    parquet.write_table(half[1], file.with_name("file-001.parquet"))
    described(folder, lambda info: [info["features"][key].update(dtype="image") for key in KEYS])
    found = shots(folder)
    assert [k for k, shot in enumerate(found) if shot.problem] == [7]
    assert found[7].problem.startswith("the left image cannot be read at 0.200 s: ")
    assert [(shot.left[0, 0, 0], shot.right[0, 0, 0]) for shot in found[:7]] == [
        (10 * k, 100 + 10 * k) for k in range(7)
    ]
    second = shots(folder, ",episode=1")
    assert [shot.left[0, 0, 0] for shot in second if shot.problem is None] == [50, 60, 80, 90]


@pytest.mark.parametrize(
    "where", [("info", "is_depth_map"), ("info", "video.is_depth_map"), ("video_info", "video.is_depth_map")]
)
def test_depth_maps_are_no_cameras(dataset, where):
    folder = dataset("v3.0")
    depth = {"dtype": "video", where[0]: {where[1]: True}}
    described(folder, lambda info: info["features"].update({"observation.images.depth": depth}))
    assert LeRobotDataset(folder).cameras() == sorted(KEYS)


def test_a_later_episode_is_found_without_decoding_those_before(dataset, monkeypatch):
    folder = dataset("v3.0")
    decoded = []
    going = Film.next
    monkeypatch.setattr(Film, "next", lambda self: decoded.append(self.path) or going(self))
    source = open_source(f"lerobot:{folder},episode=1")
    assert abs(float(np.mean(source.read().left)) - 50) < 4
    assert len(decoded) <= 4  # key frames are two apart


def test_an_episode_without_its_video_is_left_out_and_said(dataset):
    folder = dataset("v2.1")
    lost = folder / "videos" / "chunk-000" / KEYS[1] / "episode_000001.mp4"
    lost.unlink()
    source = open_source(f"lerobot:{folder}")
    (note,) = notes_of(source)
    assert note.startswith(f"episode 1: {lost}: the video of {KEYS[1]} is missing")
    found = list(iter(source.read, None))
    assert [shot.problem is None for shot in found] == [True] * 5 + [False] * 5
    assert "is missing: download the dataset" in found[7].problem
    for file in (folder / "videos").glob("**/*.mp4"):
        file.unlink()
    with pytest.raises(InputError, match="is missing: download the dataset with its videos"):
        open_source(f"lerobot:{folder}")


def test_a_video_that_is_cut_short_gives_shots_with_a_problem(dataset):
    folder = dataset("v2.1")
    video(folder / "videos" / "chunk-000" / KEYS[0] / "episode_000000.mp4", [0, 10, 20])
    found = shots(folder)
    assert [shot.problem is None for shot in found] == [True] * 3 + [False] * 2 + [True] * 5
    assert found[3].problem == "the left video has no frame at 0.300 s of episode 0"
    (folder / "videos" / "chunk-000" / KEYS[0] / "episode_000001.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match="not a video file"):
        shots(folder, ",episode=1")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda info: info.update(codebase_version="v1.6"), "codebase_version v1.6 is not read; v2 and v3 are"),
        (lambda info: info.pop("features"), "damaged"),
        (lambda info: info["features"].pop(KEYS[1]), "two cameras are needed"),
        (lambda info: info.update(video_path="{video_key:>2000000000}"), "is none of lerobot's"),
        (lambda info: info.update(video_path="{video_key.__class__}"), "is none of lerobot's"),
        (lambda info: info.update(video_path="{video_chunk:03d}.mp4"), "is none of lerobot's"),
    ],
)
def test_a_dataset_that_cannot_be_read_is_one_line(dataset, change, said):
    folder = dataset("v2.1")
    described(folder, change)
    with one_line(match=said):
        open_source(f"lerobot:{folder}")
