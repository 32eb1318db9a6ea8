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
    done: dict[int, Done] = {}
    todo = iter(range(len(items)))  # who takes an index from it is the only one

    def take() -> None:
        for index in todo:
            done[index] = work(items[index])

    others = [_pool().submit(take) for _ in range(min(threads(), len(items)) - 1)]
    try:
        take()  # no thread need be woken for the caller's share
    finally:
        for other in others:
            if not other.cancel():  # one that has not begun finds nothing to do
                other.result()
    return [done[index] for index in range(len(items))]


def threads() -> int:
    """Returns how many there are: one for each core that this process may use."""
    return min(len(os.sched_getaffinity(0)), MAX_THREADS)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads(), "parallel")
