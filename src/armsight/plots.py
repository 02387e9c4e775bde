"""Axes for the ``plot`` of results, where matplotlib is installed."""

from __future__ import annotations

from typing import Any

from armsight.errors import InputError


def new_axes(rows: int, **options: Any) -> Any:  # noqa: ANN401 - matplotlib is no dependency
    """Return axes one below the other that share their x, of a new figure.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        raise InputError('plot needs matplotlib, which is not installed: pip install "armsight[report]"') from None
    return plt.subplots(rows, 1, sharex=True, layout="constrained", **options)[1]
