"""Sources of shots: a spec such as ``KIND:...`` or the path of a folder goes in, one shot after another comes out.

The contract is in ``vision/source.py``; :func:`open_source` opens a spec.

- Recordings: ``folder.py``, ``pairs.py`` (two globs of images), ``video.py``, ``bag/`` (of ROS and Foxglove),
  ``lerobot.py``.
- Live cameras: ``usb.py``, ``url.py``, with ``timing.py`` (pairing by time stamp) and ``capture.py`` (OpenCV's
  capture).
- ``v4l2.py``: the attached cameras and their formats, for ``armsight cameras``.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from armsight.errors import InputError
from armsight.vision.source import Source
from armsight.vision.sources.bag import open_bag_source
from armsight.vision.sources.bag.reader import SUFFIXES
from armsight.vision.sources.folder import FolderSource
from armsight.vision.sources.lerobot import open_lerobot
from armsight.vision.sources.pairs import PairsSource
from armsight.vision.sources.usb import open_usb
from armsight.vision.sources.video import open_video

__all__ = ["SOURCES", "FolderSource", "PairsSource", "Source", "check_source", "lent", "notes_of", "open_source"]


def _open_url(rest: str) -> Source:
    from armsight.vision.sources.url import open_url  # not above: with it come http and TLS

    return open_url(rest)


#: Kind -> what opens the rest of the text; another kind of source is one line here.
SOURCES: dict[str, Callable[[str], Source]] = {
    "folder": FolderSource.open,
    "video": open_video,
    "url": _open_url,
    "usb": open_usb,
    "bag": open_bag_source,
    "lerobot": open_lerobot,
}


#: Kinds that are cameras.
LIVE = ("usb:", "url:")


def check_source(spec: str) -> None:
    """Reject a text that can never be a source; what it names may come later.

    Raises:
        InputError: neither a known kind nor a folder.
    """
    kind, colon, _ = spec.partition(":")
    if not (colon and kind in SOURCES) and not os.path.isdir(os.path.expanduser(spec)):
        known = ", ".join(f"{name}:..." for name in SOURCES)
        hint = ""
        if "://" in spec or spec.startswith("/dev/video"):
            hint = f" ({'url' if '://' in spec else 'usb'}:LEFT,RIGHT?)"
        elif os.path.isfile(os.path.expanduser(spec)):
            hint = f" ({'bag' if spec.endswith(SUFFIXES) else 'video'}:{spec}?)"
        raise InputError(f"{spec}: not a source{hint}: known are {known}, or the path of a folder")


def open_source(spec: str | Path) -> Source:
    """Open a source.

    Args:
        spec: ``folder:DIR`` or the path of a folder, ``video:LEFT,RIGHT`` or ``video:SIDE_BY_SIDE``, ``bag:FILE``,
            ``url:URL_LEFT,URL_RIGHT``, ``usb:LEFT,RIGHT[@WIDTHxHEIGHT][@FPS][,exposure=5ms]``; docs/howto/sources.md.

    Raises:
        InputError: an unknown kind, or what is named is not there or not usable.
        DeviceError: a camera does not answer.
    """
    check_source(spec := str(spec))
    kind, colon, rest = spec.partition(":")
    return SOURCES[kind](rest) if colon and kind in SOURCES else FolderSource.open(spec)


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
