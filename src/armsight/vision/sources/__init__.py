"""Sources of shots: a spec such as ``KIND:...`` or the path of a folder goes in, one shot after another comes out.

The contract is in ``vision/source.py``; :func:`open_source` opens a spec.

- Recordings: ``folder.py``, ``pairs.py`` (two globs of images), ``video.py``, ``bag/`` (of ROS and Foxglove),
  ``lerobot.py``.
- Live cameras: ``usb.py``, ``url.py``, with ``capture.py`` (OpenCV's capture, pairing by time stamp).
- ``v4l2.py``: the attached cameras and their formats, for ``armsight cameras``.
"""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from armsight.errors import InputError
from armsight.vision.rig import StereoRig
from armsight.vision.source import Source
from armsight.vision.sources.folder import FolderSource
from armsight.vision.sources.pairs import PairsSource

__all__ = [
    "SOURCES",
    "FolderSource",
    "PairsSource",
    "Source",
    "check_source",
    "lent",
    "notes_of",
    "open_rig",
    "open_source",
]


def _later(module: str, name: str) -> Callable[[str], Source]:
    """Return a function of a module beside, which is imported when it is called: with them come http, SQLite, Parquet."""

    def opened(rest: str) -> Source:
        source: Source = getattr(importlib.import_module(f"{__name__}.{module}"), name)(rest)
        return source

    return opened


#: Kind -> what opens the rest of the text; another kind of source is one line here.
SOURCES: dict[str, Callable[[str], Source]] = {
    "folder": FolderSource.open,
    "pairs": PairsSource.of,
    "video": _later("video", "open_video"),
    "url": _later("url", "open_url"),
    "usb": _later("usb", "open_usb"),
    "bag": _later("bag", "open_bag_source"),
    "lerobot": _later("lerobot", "open_lerobot"),
}


#: Kinds of one path: an empty one would be the current folder.
_PATHS = ("folder", "bag", "lerobot")
#: Kinds that are cameras.
LIVE = ("usb:", "url:")


def check_source(spec: str) -> None:
    """Reject a text that can never be a source; what it names may come later.

    Raises InputError: neither a known kind nor a folder.
    """
    kind, colon, rest = spec.partition(":")
    if not (colon and kind in SOURCES) and not os.path.isdir(os.path.expanduser(spec)):
        known = ", ".join(f"{name}:..." for name in SOURCES)
        hint = ""
        if "://" in spec or spec.startswith("/dev/video"):
            hint = f" ({'url' if '://' in spec else 'usb'}:LEFT,RIGHT?)"
        elif spec.replace(",", "").isdecimal():
            hint = f" (usb:{spec if ',' in spec else f'{spec},{int(spec) + 1}'}?)"
        elif os.path.isfile(os.path.expanduser(spec)):
            from armsight.vision.sources.bag.reader import SUFFIXES

            hint = f" ({'bag' if spec.endswith(SUFFIXES) else 'video'}:{spec}?)"
        gone = ", and there is no such folder" if os.sep in spec and not hint else ""
        raise InputError(f"{spec.rstrip(':')}: not a source{hint}: known are {known}, or the path of a folder{gone}")
    if colon and kind in SOURCES and (rest.startswith(":") or (kind in _PATHS and not rest.strip())):
        raise InputError(f"{spec!r}: expected '{kind}:' and then what it opens, with one colon (armsight record -h)")


def open_source(spec: str | Path) -> Source:
    """Open a source.

    ``spec``: ``folder:DIR`` or the path of a folder, ``pairs:LEFT_GLOB,RIGHT_GLOB``, ``video:LEFT,RIGHT`` or
    ``video:SIDE_BY_SIDE``, ``bag:FILE``, ``lerobot:DIR``, ``url:URL_LEFT,URL_RIGHT``,
    ``usb:LEFT,RIGHT[@WIDTHxHEIGHT][@FPS][,exposure=5ms]``. Without cameras: ``armsight.sim.example_rig.demo_recording``
    writes a small recording and its target; its rig is returned. Raises InputError: an unknown kind, or what is named is
    not there or not usable; DeviceError: a camera does not answer.
    """
    check_source(spec := str(spec))
    kind, colon, rest = spec.partition(":")
    return SOURCES[kind](rest) if colon and kind in SOURCES else FolderSource.open(spec)


def open_rig(spec: str | Path) -> StereoRig:
    """Read a rig: a rig file, or ``bag:FILE`` for the camera_info of a recording.

    Raises InputError: it is not there, damaged, or the recording holds no stereo pair.
    """
    text = str(spec)
    if not text.startswith("bag:"):
        return StereoRig.load_trusted(spec)
    from armsight.vision.sources.bag.camera_info import bag_rig
    from armsight.vision.sources.bag.images import parsed
    from armsight.vision.sources.bag.reader import Bag

    path, named = parsed(text.removeprefix("bag:"))
    return bag_rig(Bag(path), named)


@contextlib.contextmanager
def lent(source: Source | str | Path) -> Iterator[Source]:
    """Open what :func:`open_source` opens for a block; a source that is open already stays open."""
    if not isinstance(source, str | Path):
        yield source
        return
    with contextlib.closing(open_source(source)) as opened:
        yield opened


def notes_of(source: Source) -> tuple[str, ...]:
    """Return what a source left out or found odd, so far, a line each."""
    return tuple(getattr(source, "notes", ()))
