"""A LeRobot dataset: two of its cameras as shots, and its joints.

In: the folder of a dataset of format 2 or 3 (meta/info.json, Parquet tables, one MP4 an episode or a file, usually AV1).
Out: one shot a frame of the table, with the table's time stamp. Read are the features of dtype ``video``, and ``image``,
which stand in the table (lerobot's ``use_videos=False``); depth maps are not. Which two are left and right their names say,
or the user does: ``lerobot:DIR,left=KEY,right=KEY``; ``episode=N`` reads one episode alone.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from armsight.data import SIDES, Array, Image, Record, Shot
from armsight.errors import InputError
from armsight.files import opened, read_json
from armsight.vision.image import decoded
from armsight.vision.source import PlayedSource
from armsight.vision.sources.video import Film

#: Columns of a table by name.
_Columns: TypeAlias = dict[str, list[Any]]
#: A file of the library pyarrow.
_Parquet: TypeAlias = Any
_JOINTS = "observation.state"
#: Cells of a table that are read; a small file can hold any number of equal ones. Half: 10 hours of six joints are
#: rejected; double: 600 MB.
_CELLS = 10_000_000


@dataclass(frozen=True, eq=False)
class LeRobotJoints(Record):
    """The joints of a dataset by its names: values (N, n) in the unit of the robot's driver.

    Times (N,), s, count from the beginning of each episode, whose number is in ``episode`` (N,).
    """

    names: tuple[str, ...]
    t_s: Array
    values: Array
    episode: Array


def _is_depth(feature: dict[str, Any]) -> bool:
    """Return whether a camera gives distances: lerobot marks it in one of three ways."""
    about = (feature.get("info") or {}, feature.get("video_info") or {})
    return any(each.get("is_depth_map") or each.get("video.is_depth_map") for each in about)


def _parquet_files(folder: Path, part: str) -> Iterator[tuple[Path, _Parquet]]:
    """Yield the Parquet files of a part of a dataset, each open while it is used."""
    try:
        from pyarrow import parquet
    except ImportError:
        raise InputError(
            f'{folder}: its tables need pyarrow, which is not installed: pip install "armsight[ros]"'
        ) from None
    files = sorted((folder / part).glob("**/*.parquet"))
    if not files:
        raise InputError(f"{folder}: holds no table: there is no {part}/**/*.parquet")
    for file in files:
        with opened(file) as stream:
            try:
                table = parquet.ParquetFile(stream)
            except (OSError, ValueError) as error:
                raise InputError(f"{file}: damaged, or a column is missing: {' '.join(str(error).split())}") from None
            yield file, table


class LeRobotDataset:
    """A dataset's description and its table of frames; InputError where it is none, unknown or damaged."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        path = self.folder / "meta" / "info.json"
        if not path.exists():
            raise InputError(f"{folder}: no LeRobot dataset: there is no meta/info.json")
        try:
            self.info: dict[str, Any] = read_json(path)
            self.features: dict[str, dict[str, Any]] = dict(self.info["features"])
            version = str(self.info["codebase_version"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: damaged: {error}") from None
        if version.split(".")[0] not in ("v2", "v3"):
            raise InputError(f"{path}: codebase_version {version} is not read; v2 and v3 are")
        self.version = version

    def cameras(self) -> list[str]:
        """Return the keys of its cameras."""
        return sorted(
            key
            for key, each in self.features.items()
            if each.get("dtype") in ("video", "image") and not _is_depth(each)
        )

    def table(self, columns: list[str]) -> _Columns:
        """Return columns of the frames' table, in the order of the frames."""
        found: _Columns = {name: [] for name in columns}
        for file, table in _parquet_files(self.folder, "data"):
            cells = sum(
                group.column(k).num_values
                for group in (table.metadata.row_group(n) for n in range(table.num_row_groups))
                for k in range(group.num_columns)
                if group.column(k).path_in_schema.split(".")[0] in columns
            )
            if cells > _CELLS:
                raise InputError(f"{file}: {cells} cells, more than {_CELLS}: split the dataset")
            try:
                read = table.read(columns=columns).to_pydict()
                for name in columns:
                    found[name] += read[name]
            except (OSError, ValueError, KeyError) as error:
                raise InputError(f"{file}: damaged, or a column is missing: {' '.join(str(error).split())}") from None
        return found

    def images(self, key: str) -> Iterator[Image | str]:
        """Yield a camera's image of every frame of the table, or why it cannot be decoded."""
        for file, table in _parquet_files(self.folder, "data"):
            for batch in table.iter_batches(batch_size=1, columns=[key]):
                stored = batch.column(0)[0].as_py() or {}
                try:
                    yield decoded(stored.get("bytes") or b"", f"{file}: {key}")
                except InputError as error:
                    yield str(error)

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
        """Return an episode's file of a camera, and when the episode begins in it, s; InputError if it is missing."""
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
        template = str(self.info.get("video_path"))
        try:
            if re.search(r"\{(?!\w+(:0?\d{1,2}d?)?\})", template):
                raise ValueError
            path = self.folder / template.format(**names)
        except (KeyError, ValueError):
            raise InputError(
                f"{self.folder}: meta/info.json: video_path {template[:80]!r} is none of lerobot's"
            ) from None
        if not path.is_file():
            raise InputError(f"{path}: the video of {key} is missing: download the dataset with its videos")
        return path, begin_s

    def _episode(self, episode: int) -> dict[str, Any]:
        """Return the row of an episode in meta/episodes, of format 3."""
        for _, table in _parquet_files(self.folder, "meta/episodes"):
            names = [name for name in table.schema_arrow.names if name.startswith(("videos/", "episode_index"))]
            for row in table.read(columns=names).to_pylist():
                if row["episode_index"] == episode:
                    return dict(row)
        raise InputError(f"{self.folder}: meta/episodes does not describe episode {episode}")


class LeRobotSource(PlayedSource):
    """Two cameras of a dataset; a frame that cannot be decoded is a shot with a problem."""

    def __init__(self, dataset: LeRobotDataset, keys: tuple[str, str], episode: int | None) -> None:
        table = dataset.table(["timestamp", "episode_index", "frame_index"])
        stamps, episodes, frames = (np.array(column).reshape(-1) for column in table.values())
        self._dataset, self._keys = dataset, keys
        self._rows = [  # row of the table, time, episode, frame
            (row, float(t), int(e), int(f))
            for row, (t, e, f) in enumerate(zip(stamps, episodes, frames, strict=True))
            if episode is None or e == episode
        ]
        if not self._rows:
            raise InputError(f"{dataset.folder}: holds no frame of episode {episode}")
        missing: dict[int, str] = {}
        videos = [key for key in keys if dataset.features[key]["dtype"] == "video"]
        numbers = sorted({e for _, _, e, _ in self._rows})
        for number in numbers:
            try:
                for key in videos:
                    dataset.video(key, number)
            except InputError as error:
                missing[number] = str(error)
        if len(missing) == len(numbers):
            raise InputError(next(iter(missing.values())))
        self._missing = missing
        notes = tuple(f"episode {number}: {why}: left out" for number, why in missing.items())
        super().__init__(self._read, len(self._rows), notes)

    def _read(self, every: int) -> Generator[Shot]:
        number, views = None, tuple[_View, ...]()
        begin_s, last_s = 0.0, 0.0
        try:
            for row, t_s, episode, frame in self._rows[::every]:
                if number != episode:
                    # Episodes begin at 0 each; a shot's times must rise.
                    begin_s = 0.0 if number is None else last_s + 1.0
                    number, old = episode, views
                    missing = episode in self._missing
                    views = () if missing else tuple(self._view(key, episode, old) for key in self._keys)
                    for view in old:
                        if view not in views:
                            view.close()
                last_s = begin_s + t_s
                name = f"{episode:03d}-{frame:06d}"
                images = [view.at(row, t_s) for view in views]
                problem = self._missing.get(episode)
                for side, image in zip(SIDES, images, strict=False):
                    if isinstance(image, str) and problem is None:
                        problem = f"the {side} {image} of episode {episode}"
                left, right = (
                    each if problem is None and not isinstance(each, str) else None for each in images or (None, None)
                )
                yield Shot(name, left, right, last_s, problem)
        finally:
            for view in views:
                view.close()

    def _view(self, key: str, episode: int, before: tuple[_View, ...]) -> _View:
        """Return a camera's images of an episode: the table's go on, a video is opened."""
        if self._dataset.features[key]["dtype"] == "image":
            return next((each for each in before if each.key == key), None) or _TableView(
                key, self._dataset.images(key)
            )
        path, begin_s = self._dataset.video(key, episode)
        return _VideoView(key, path, begin_s)


class _TableView:
    """A camera's images that stand in the table of frames, read forwards."""

    def __init__(self, key: str, images: Iterator[Image | str]) -> None:
        self.key, self._images, self._next = key, images, 0

    def at(self, row: int, t_s: float) -> Image | str:
        """Return the image of a row of the table, or why there is none."""
        image: Image | str = ""
        while self._next <= row:
            image, self._next = next(self._images, "table ends"), self._next + 1
        return f"image cannot be read at {t_s:.3f} s: {image}" if isinstance(image, str) else image

    def close(self) -> None:
        """Close the table."""
        self._images = iter(())


class _VideoView:
    """A camera's video, read forwards from the beginning of an episode, s."""

    def __init__(self, key: str, path: Path, begin_s: float) -> None:
        self.key, self._film, self._begin_s = key, Film(str(path)), begin_s
        self._half_s = min(0.5, self._film.period_s / 2)
        self._film.seek(begin_s)

    def at(self, row: int, t_s: float) -> Image | str:
        """Return the frame at a time of the episode, or why there is none."""
        while self._film.next():
            if self._film.t_s >= self._begin_s + t_s - self._half_s:
                return self._film.image()
        return f"video has no frame at {t_s:.3f} s"

    def close(self) -> None:
        """Close the file."""
        self._film.close()


_View: TypeAlias = _TableView | _VideoView


def open_lerobot(rest: str) -> LeRobotSource:
    """Open ``DIR[,left=KEY,right=KEY][,episode=N]``.

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
