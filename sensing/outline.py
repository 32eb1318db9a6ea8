"""Outlines of buildings in the plane: triangulation, containment, overlap."""

from __future__ import annotations

import numpy as np

from protocol.geometry import Floats


def signed_area_m2(outline: Floats) -> float:
    """Returns the area within an outline (K, 2), positive if it runs counter-clockwise."""
    after = np.roll(outline, -1, axis=0)
    return float(np.sum(outline[:, 0] * after[:, 1] - after[:, 0] * outline[:, 1]) / 2)


def triangulate(outline: Floats) -> list[tuple[int, int, int]]:
    """Cuts the ears off a counter-clockwise outline (K, 2); indices are into it.

    An outline that crosses itself yields the triangles found until no ear is left.
    """
    left = list(range(len(outline)))
    found: list[tuple[int, int, int]] = []
    while len(left) > 3:
        ear = next((k for k in range(len(left)) if _is_ear(outline, left, k)), None)
        if ear is None:
            return found
        found.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return [*found, (left[0], left[1], left[2])]


def contains(outline: Floats, places: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Returns for places (N, 2) whether they lie within an outline (K, 2)."""
    x, y = places[:, 0], places[:, 1]
    inside = np.zeros(len(places), np.bool_)
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return inside


def overlap(one: Floats, other: Floats) -> bool:
    """Returns whether two convex outlines meet: no side of either separates them."""
    for outline in (one, other):
        side = np.roll(outline, -1, axis=0) - outline
        for normal in np.column_stack([-side[:, 1], side[:, 0]]):
            a = one[:, 0] * normal[0] + one[:, 1] * normal[1]
            b = other[:, 0] * normal[0] + other[:, 1] * normal[1]
            if a.max() < b.min() or b.max() < a.min():
                return False
    return True


def _is_ear(outline: Floats, left: list[int], k: int) -> bool:
    ear = [left[k - 1], left[k], left[(k + 1) % len(left)]]
    corners = outline[ear]
    if signed_area_m2(corners) <= 0:
        return False
    others = [i for i in left if i not in ear]
    return not contains(corners, outline[others]).any()
