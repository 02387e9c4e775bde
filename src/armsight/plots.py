"""A figure for the ``plot`` of results, where matplotlib is installed."""

from __future__ import annotations

from typing import Any

from armsight.errors import InputError


def new_figure(rows: int, columns: int, **options: Any) -> Any:  # noqa: ANN401 - matplotlib is no dependency
    """Return a new figure and its axes (rows, columns), without dimensions of one.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        raise InputError('plot needs matplotlib, which is not installed: pip install "armsight[report]"') from None
    return plt.subplots(rows, columns, layout="constrained", **options)
