"""Records, arrays and paths in, what JSON holds out."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def json_of(value: Any) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return records, arrays, paths and what holds them as JSON has it; null replaces every NaN and infinity."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {each.name: json_of(getattr(value, each.name)) for each in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): json_of(each) for key, each in value.items()}
    if hasattr(value, "_asdict"):
        return json_of(value._asdict())
    if hasattr(value, "tolist"):  # an array or a number of numpy
        return json_of(value.tolist())
    if isinstance(value, list | tuple):
        return [json_of(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
