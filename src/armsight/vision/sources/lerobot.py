"""A LeRobot dataset: two of its cameras as shots, and its joints.

In: the folder of a dataset of format 2 or 3 (meta/info.json, Parquet tables, one MP4 an episode or a file, usually AV1).
Out: one shot a frame of the table, with the table's time stamp. Read are the features of dtype ``video``; which two are
left and right their names say, or the user does: ``lerobot:DIR,left=KEY,right=KEY``; ``episode=N`` reads one episode alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from armsight.data import SIDES, Array, Image, Record, Shot
from armsight.errors import InputError
from armsight.files import read_text
from armsight.vision.sources.capture import QuietCapture, open_capture

#: Columns of a table by name.
_Columns: TypeAlias = dict[str, list[Any]]
_JOINTS = "observation.state"


@dataclass(frozen=True, eq=False)
class LeRobotJoints(Record):
    """The joints of a dataset.

    Attributes:
        names: (n) of the joints, as the dataset has them.
        t_s: (N,) times, s, from the beginning of each episode.
        values: (N, n) values as they are in the dataset; its unit is that of the robot's driver.
        episode: (N,) number of the episode.
    """

    names: tuple[str, ...]
    t_s: Array
    values: Array
    episode: Array


class LeRobotDataset:
    """A dataset's description and its table of frames.

    Args:
        folder: of the dataset.

    Raises:
        InputError: no dataset, one of an unknown format, or a table that is missing or damaged.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        path = self.folder / "meta" / "info.json"
        if not path.is_file():
            raise InputError(f"{folder}: no LeRobot dataset: there is no meta/info.json")
        try:
            self.info: dict[str, Any] = json.loads(read_text(path))
            self.features: dict[str, dict[str, Any]] = dict(self.info["features"])
            version = str(self.info["codebase_version"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: damaged: {error}") from None
        if version.split(".")[0] not in ("v2", "v3"):
            raise InputError(f"{path}: codebase_version {version} is not read; v2 and v3 are")
        self.version = version

    def cameras(self) -> list[str]:
        """Return the keys of its cameras."""
        return sorted(key for key, feature in self.features.items() if feature.get("dtype") == "video")

    def table(self, columns: list[str]) -> _Columns:
        """Return columns of the frames' table, in the order of the frames."""
        try:
            from pyarrow import parquet
        except ImportError:
            raise InputError(
                f'{self.folder}: its tables need pyarrow, which is not installed: pip install "armsight[ros]"'
            ) from None
        files = sorted((self.folder / "data").glob("**/*.parquet"))
        if not files:
            raise InputError(f"{self.folder}: holds no table: there is no data/**/*.parquet")
        found: _Columns = {name: [] for name in columns}
        for file in files:
            try:
                read = parquet.read_table(file, columns=columns).to_pydict()
            except (OSError, ValueError, KeyError) as error:
                raise InputError(f"{file}: damaged, or a column is missing: {' '.join(str(error).split())}") from None
            for name in columns:
                found[name] += read[name]
        return found

    def joints(self) -> LeRobotJoints:
        """Return the joints of all frames."""
        if _JOINTS not in self.features:
            raise InputError(f"{self.folder}: holds no {_JOINTS}")
        table = self.table(["timestamp", "episode_index", _JOINTS])
        values = np.array(table[_JOINTS], float)
        names = self.features[_JOINTS].get("names") or [f"joint{k + 1}" for k in range(values.shape[1])]
        listed = names if isinstance(names, list) else next(iter(names.values()))
        stamps, episodes = (np.array(table[key], float).reshape(-1) for key in ("timestamp", "episode_index"))
        return LeRobotJoints(tuple(map(str, listed)), stamps, values, episodes)

    def video(self, key: str, episode: int) -> tuple[Path, float]:
        """Return the file that holds an episode of a camera, and when the episode begins in it, s.

        Raises:
            InputError: the file is missing.
        """
        if self.version.startswith("v2"):
            chunk = episode // int(self.info.get("chunks_size", 1000))
            names: dict[str, Any] = {"episode_chunk": chunk, "video_key": key, "episode_index": episode}
            begin_s = 0.0
        else:
            row = self._episode(episode)
            prefix = f"videos/{key}"
            names = {"video_key": key}
            names |= {f"{part}_index": int(row[f"{prefix}/{part}_index"]) for part in ("chunk", "file")}
            begin_s = float(row.get(f"{prefix}/from_timestamp", 0.0))
        path = self.folder / str(self.info["video_path"]).format(**names)
        if not path.is_file():
            raise InputError(f"{path}: the video of {key} is missing: download the dataset with its videos")
        return path, begin_s

    def _episode(self, episode: int) -> dict[str, Any]:
        """Return the row of an episode in meta/episodes, of format 3."""
        from pyarrow import parquet

        for file in sorted((self.folder / "meta" / "episodes").glob("**/*.parquet")):
            for row in parquet.read_table(file).to_pylist():
                if row["episode_index"] == episode:
                    return dict(row)
        raise InputError(f"{self.folder}: meta/episodes does not describe episode {episode}")


class LeRobotSource:
    """Two cameras of a dataset; a frame that cannot be decoded is a shot with a problem.

    Attributes:
        notes: what was left out: episodes without a video.
    """

    def __init__(self, dataset: LeRobotDataset, keys: tuple[str, str], episode: int | None) -> None:
        table = dataset.table(["timestamp", "episode_index", "frame_index"])
        columns = (np.array(table[key]).reshape(-1) for key in ("timestamp", "episode_index", "frame_index"))
        stamps, episodes, frames = columns
        self._dataset, self._keys = dataset, keys
        self._rows = [
            (float(t), int(e), int(f))
            for t, e, f in zip(stamps, episodes, frames, strict=True)
            if episode is None or e == episode
        ]
        if not self._rows:
            raise InputError(f"{dataset.folder}: holds no frame of episode {episode}")
        missing: dict[int, str] = {}
        for number in sorted({e for _, e, _ in self._rows}):
            try:
                for key in keys:
                    dataset.video(key, number)
            except InputError as error:
                missing[number] = str(error)
        if len(missing) == len({e for _, e, _ in self._rows}):
            raise InputError(next(iter(missing.values())))
        self._missing = missing
        self.notes = tuple(f"episode {number}: {why}: left out" for number, why in missing.items())
        self._ended = False
        self._shots = self._read()

    @property
    def count(self) -> int | None:
        """How many frames there are, those of missing videos included."""
        return len(self._rows)

    def read(self) -> Shot | None:
        """Return the next shot, or None at the end."""
        return None if self._ended else next(self._shots, None)

    def close(self) -> None:
        """Close the videos."""
        self._ended = True
        next(self._shots, None)

    def _read(self) -> Iterator[Shot]:
        opened: tuple[int, list[_EpisodeVideo]] | None = None
        begin_s, last_s = 0.0, 0.0
        try:
            for t_s, episode, frame in self._rows:
                if self._ended:
                    return
                name = f"{episode:03d}-{frame:06d}"
                if opened is None or opened[0] != episode:
                    for video in opened[1] if opened else ():
                        video.capture.release()
                    # Episodes begin at 0 each; a shot's times must rise.
                    begin_s = 0.0 if opened is None else last_s + 1.0
                    files = (
                        []
                        if episode in self._missing
                        else [_EpisodeVideo.open(*self._dataset.video(k, episode)) for k in self._keys]
                    )
                    opened = (episode, files)
                last_s = begin_s + t_s
                if not opened[1]:
                    yield Shot(name, None, None, last_s, self._missing[episode])
                    continue
                images = [video.at(t_s) for video in opened[1]]
                if images[0] is None or images[1] is None:
                    side = SIDES[0] if images[0] is None else SIDES[1]
                    yield Shot(
                        name, None, None, last_s, f"the {side} video has no frame at {t_s:.3f} s of episode {episode}"
                    )
                    continue
                yield Shot(name, images[0], images[1], last_s)
        finally:
            for video in opened[1] if opened else ():
                video.capture.release()


class _EpisodeVideo:
    """A video file, read forwards from the beginning of an episode."""

    @staticmethod
    def open(path: Path, begin_s: float) -> _EpisodeVideo:
        capture = open_capture(str(path))
        if capture is None:
            raise InputError(f"{path}: not a video that this OpenCV can decode (AV1 needs a build of FFmpeg with it)")
        return _EpisodeVideo(capture, begin_s)

    def __init__(self, capture: QuietCapture, begin_s: float) -> None:
        import cv2

        self.capture, self._begin_s = capture, begin_s
        fps = capture.get(cv2.CAP_PROP_FPS)
        self._half_s = 0.5 / fps if fps > 0 else 0.5
        self._stamp = cv2.CAP_PROP_POS_MSEC

    def at(self, t_s: float) -> Image | None:
        """Return the frame at a time of the episode, s; None where there is none."""
        due_s = self._begin_s + t_s
        while self.capture.grab():
            at_s = self.capture.get(self._stamp) / 1000
            if at_s >= due_s - self._half_s:
                ok, image = self.capture.retrieve()
                return image if ok else None
        return None


def open_lerobot(rest: str) -> LeRobotSource:
    """Open ``DIR[,left=KEY,right=KEY][,episode=N]``.

    Raises:
        InputError: no dataset, fewer than two cameras, or all videos are missing.
    """
    path, *options = rest.split(",")
    named = dict(option.partition("=")[::2] for option in options)
    if not set(named) <= {*SIDES, "episode"} or not all(named.values()) or len(set(SIDES) & set(named)) == 1:
        raise InputError(f"lerobot:{rest}: expected lerobot:DIR[,left=KEY,right=KEY][,episode=N]")
    if not re.fullmatch(r"\d+", named.get("episode", "0")):
        raise InputError(f"lerobot:{rest}: episode={named['episode']}: expected a number")
    dataset = LeRobotDataset(path)
    cameras = dataset.cameras()
    if "left" in named:
        keys = tuple(key if key in cameras else f"observation.images.{key}" for key in (named["left"], named["right"]))
    elif len(cameras) == 2:
        keys = tuple(sorted(cameras, key=lambda key: "right" in key))
    else:
        keys = tuple(key for word in SIDES for key in cameras if re.search(rf"(?<![a-z]){word}(?![a-z])", key))
    unknown = [key for key in keys if key not in cameras]
    if unknown or len(keys) != 2 or keys[0] == keys[1]:
        raise InputError(
            f"lerobot:{rest}: two cameras are needed, named as left=KEY,right=KEY; there are {', '.join(cameras) or 'none'}"
        )
    return LeRobotSource(dataset, (keys[0], keys[1]), int(named["episode"]) if "episode" in named else None)
