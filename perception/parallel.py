"""Threads for the parts of a cloud: compiled loops release the GIL, so they use all cores."""

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
    """Maps `work` over the items in threads; results are in the items' order."""
    done: dict[int, Done] = {}
    todo = iter(range(len(items)))  # each index is taken by one thread only

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
    """Returns the number of threads: one for each core that this process may use."""
    return min(len(os.sched_getaffinity(0)), MAX_THREADS)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads(), "parallel")
