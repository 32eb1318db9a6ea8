"""Brings together what has the same key, in the order of keys and, within, of the input."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Ints

_ROOM = 1 << 21  # keys that may be counted whatever the input's size: 8 MB


def group(keys: Ints, span: int) -> tuple[Ints, Ints, Ints]:
    """Groups keys (N,) from 0 to below `span`.

    Returns:
        The order (N,) that brings groups together, the groups' keys (G,), ascending, and where
        each begins in that order, with N at the end (G + 1,).
    """
    if span <= max(_ROOM, 8 * len(keys)):
        order, groups, starts = _counted(keys, span)  # several times as fast as sorting
        return order, groups, starts
    order = np.argsort(keys, kind="stable")
    groups, starts = np.unique(keys[order], return_index=True)
    return order, groups, np.append(starts, len(keys))


@njit("Tuple((int64[::1], int64[::1], int64[::1]))(int64[::1], int64)", cache=True)
def _counted(keys: Ints, span: int) -> tuple[Ints, Ints, Ints]:
    counts = np.zeros(span, np.int32)
    for key in keys:
        counts[key] += 1
    groups = np.empty(min(keys.size, span), np.int64)
    starts = np.empty(groups.size + 1, np.int64)
    found, start = 0, 0
    for key in range(span):
        size = counts[key]
        counts[key] = start
        if size > 0:
            groups[found], starts[found] = key, start
            found, start = found + 1, start + size
    starts[found] = start
    order = np.empty(keys.size, np.int64)
    for index in range(keys.size):
        key = keys[index]
        order[counts[key]] = index
        counts[key] += 1
    return order, groups[:found].copy(), starts[: found + 1].copy()
