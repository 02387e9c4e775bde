"""What all published data have in common, and their JSON, in which NaN and infinity are null."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from armsight.app.show.encode import json_of
from armsight.data import Array, Body, Record

try:
    import orjson  # of the extra ``record``; five times as fast
except ImportError:
    orjson = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm
    from armsight.vision.rig import StereoRig


@dataclass(frozen=True, eq=False)
class Published(Record):
    """What all data of a run have in common."""

    rig: StereoRig | None = None  #: the calibrated cameras; None where they are not known
    #: what is measured; without points where nothing is
    body: Body = field(default_factory=lambda: Body("", (), np.zeros((0, 3))))
    arm: Arm | None = None  #: the nominal arm; None where there is none
    #: texts that are stored with a recording: files, versions, options
    properties: Mapping[str, str] = field(default_factory=dict)
    #: brings the arm to rest, with the reason; an InputError says why it cannot; None where nothing moves
    hold: Callable[[str], None] | None = None
    #: returns those of the motors (n,), degrees Celsius, or None; None where there are no motors
    temperatures_c: Callable[[], Array | None] | None = None


def json_text(content: Mapping[str, Any]) -> bytes:
    """Return JSON in UTF-8; NaN and infinity become null."""
    if orjson is not None:
        return bytes(orjson.dumps(content, _listed, orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS))
    try:
        return json.dumps(content, allow_nan=False).encode()
    except ValueError:
        return json.dumps(json_of(content), allow_nan=False).encode()


def _listed(value: Any) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return what orjson does not know, a named tuple or an array of another layout, as JSON has it."""
    return list(value) if isinstance(value, tuple) else json_of(value)
