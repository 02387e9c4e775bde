"""Strips of rows, each by itself: to threads where there are some, with the same result for any number of them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numba


def on_strips(height: int, rows: int, work: Callable[[int, int], None]) -> None:
    """Call ``work(begin, end)`` for strips that cover all rows, on as many threads as numba may use.

    Args:
        height: rows of the image.
        rows: at most so many a strip; the strips are about equal, and do not depend on the number of threads.
        work: compiled without the interpreter's lock; writes to its own rows only.
    """
    count = -(-height // rows)
    bounds = [height * k // count for k in range(count + 1)]
    threads = min(count, numba.get_num_threads())
    if threads == 1:
        for begin, end in pairwise(bounds):
            work(begin, end)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, bounds[:-1], bounds[1:]))
