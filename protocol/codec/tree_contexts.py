"""Contexts of an octree's symbols: position and density of the preceding points.

Surfaces go on: a cell is likely occupied where the last point lies, and flat where its parent is.
So does the density of points: the level at which the last two were alone predicts that of the next.
"""

from __future__ import annotations

from numba import njit

from protocol.codec.rans import i64

STRIDE = 16
UPPER, LOWER, LONE, PLACE, COPIES, MIDDLE = 0, 216, 504, 648, 720, 725  # the first of each
CONTEXTS = 755


@njit("int64(int64, int64, int64)", cache=True, nogil=True)
def half_of(last: int, cell: int, level: int) -> int:
    """Returns in which half of a cell a coordinate lies: 1 or 2; 0 if it lies outside."""
    half = (last >> level) - 2 * cell
    return half + 1 if 0 <= half < 2 else 0


@njit("int64(int64, int64, int64)", cache=True, nogil=True)
def quarter_of(last: int, cell: int, level: int) -> int:
    """Returns in which quarter of a cell a height lies, 1 to 4; 0 if below, 5 if above."""
    quarter = (last >> (level - 1)) - 4 * cell if level > 0 else 2 * (last - 2 * cell)
    return min(max(quarter, -1), 4) + 1


@njit("int64(int64, int64, int64)", cache=True, nogil=True)
def place_context(last: int, cell: int, level: int) -> int:
    """Returns the context of a coordinate of a lone point, by that of the point before."""
    eighth = ((last - (cell << level)) << 3) >> level
    return PLACE + 12 * (min(level, 3) - 1) + min(max(eighth, -2), 9) + 2


@njit("int64(int64, int64, int64)", cache=True, nogil=True)
def lone_context(crowd: int, behind: int, above: int) -> int:
    """Returns the context of which children are alone: of how many, of the second four, depth.

    `above` says how many half levels the cell lies above the mean of those where the two points
    before were alone.
    """
    return LONE + 18 * (crowd - 1) + 9 * behind + min(max(above, -4), 4) + 4


@njit("int64(int64, int64, int64, int64, int64)", cache=True, nogil=True)
def middle_context(copies: int, level: int, rise: int, last: int, before: int) -> int:
    """Returns the context of how many points lie at the middle of their cell.

    Args:
        copies: points in the cell.
        level: where they are alone.
        rise: how much higher it lies than the cell before.
        last: 1 if the point before lies at the middle of its cell, else 0.
        before: that of the point before it.
    """
    if copies > 1:
        return MIDDLE + 24 + 2 * (min(copies, 4) - 2) + last
    context: int = (
        MIDDLE + 12 * i64(level > 0) + 4 * (min(max(rise, -1), 1) + 1) + 2 * last + before
    )
    return context


@njit("int64(int64)", cache=True, nogil=True)
def is_flat(occupied: int) -> int:
    """Returns 1 if the points of a cell are all in its upper half, or all in its lower."""
    return 1 if occupied < 16 or occupied & 15 == 0 else 0


@njit("int64(int64)", cache=True, nogil=True)
def level_of(copies: int) -> int:
    """Returns the level below 0 at which points of one cell would be alone."""
    level = 0
    while copies >> (1 - level):
        level -= 1
    return level
