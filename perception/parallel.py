"""Parts of a cloud side by side: compiled loops hold no lock, so threads use all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

MAX_THREADS = 8

Item = TypeVar("Item")
Done = TypeVar("Done")


def each(work: Callable[[Item], Done], items: Sequence[Item]) -> list[Done]:
    """Returns what `work` gives for each item, in their order."""
    if len(items) < 2 or threads() == 1:
        return [work(item) for item in items]
    return list(_pool().map(work, items))


def threads() -> int:
    """Returns how many there are: one for each core that this process may use."""
    return min(len(os.sched_getaffinity(0)), MAX_THREADS)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads(), "parallel")
