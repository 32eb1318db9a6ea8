"""How much two boxes have in common, seen from above and in space."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Ints


def overlaps(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Returns the IoU (N, M) of boxes (N, 7) and (M, 7), from above (BEV) and in space (3D)."""
    bev, space = np.zeros((len(a), len(b))), np.zeros((len(a), len(b)))
    _overlaps(np.ascontiguousarray(a, np.float64), np.ascontiguousarray(b, np.float64), bev, space)
    return bev, space


def suppress(boxes: Floats, scores: Floats, *, iou: float) -> Ints:
    """Returns which boxes (N, 7) stay when, of two that overlap more, the better one does."""
    order = np.lexsort((*boxes.T[::-1], -scores))
    kept = np.ones(len(boxes), np.bool_)
    _suppress(np.ascontiguousarray(boxes[order], np.float64), iou, kept)
    return np.asarray(order[kept])


@njit("float64(float64[::1], float64[::1])", cache=True, nogil=True)
def _common_m2(a: Floats, b: Floats) -> float:
    """Returns the area that two rectangles share: one is clipped by the other's four sides."""
    polygon, clipped = np.empty((16, 2)), np.empty((16, 2))
    turn = b[6] - a[6]
    dx, dy = b[0] - a[0], b[1] - a[1]
    cos, sin = np.cos(a[6]), np.sin(a[6])
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    cos, sin = np.cos(turn), np.sin(turn)
    for corner in range(4):
        u = b[3] / 2 * (1 if corner in (0, 3) else -1)
        v = b[4] / 2 * (1 if corner < 2 else -1)
        polygon[corner, 0], polygon[corner, 1] = x + cos * u - sin * v, y + sin * u + cos * v
    count = 4
    for side in range(4):
        axis, sign, reach = side // 2, 1 - 2 * (side % 2), a[3 + side // 2] / 2
        left = 0
        for i in range(count):
            j = (i + 1) % count
            here, there = reach - sign * polygon[i, axis], reach - sign * polygon[j, axis]
            if here >= 0:
                clipped[left] = polygon[i]
                left += 1
            if (here >= 0) != (there >= 0):
                share = here / (here - there)
                clipped[left] = polygon[i] + share * (polygon[j] - polygon[i])
                left += 1
        polygon, clipped, count = clipped, polygon, left
        if count < 3:
            return 0.0
    area = 0.0
    for i in range(count):
        j = (i + 1) % count
        area += polygon[i, 0] * polygon[j, 1] - polygon[j, 0] * polygon[i, 1]
    return abs(area) / 2


@njit("boolean(float64[::1], float64[::1])", cache=True, nogil=True)
def _near(a: Floats, b: Floats) -> bool:
    reach = (np.hypot(a[3], a[4]) + np.hypot(b[3], b[4])) / 2
    return bool((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 < reach * reach)


@njit("void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1])", cache=True)
def _overlaps(a: Floats, b: Floats, bev: Floats, space: Floats) -> None:
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            if not _near(a[i], b[j]):
                continue
            area = _common_m2(a[i], b[j])
            areas = a[i, 3] * a[i, 4] + b[j, 3] * b[j, 4]
            bev[i, j] = area / max(areas - area, 1e-12)
            top = min(a[i, 2] + a[i, 5] / 2, b[j, 2] + b[j, 5] / 2)
            bottom = max(a[i, 2] - a[i, 5] / 2, b[j, 2] - b[j, 5] / 2)
            volume = area * max(top - bottom, 0.0)
            volumes = a[i, 3] * a[i, 4] * a[i, 5] + b[j, 3] * b[j, 4] * b[j, 5]
            space[i, j] = volume / max(volumes - volume, 1e-12)


@njit("void(float64[:,::1], float64, boolean[::1])", cache=True, nogil=True)
def _suppress(boxes: Floats, iou: float, kept: Bools) -> None:
    """Goes through boxes in order of their score, best first."""
    for i in range(boxes.shape[0]):
        if not kept[i]:
            continue
        for j in range(i + 1, boxes.shape[0]):
            if kept[j] and _near(boxes[i], boxes[j]):
                area = _common_m2(boxes[i], boxes[j])
                areas = boxes[i, 3] * boxes[i, 4] + boxes[j, 3] * boxes[j, 4]
                kept[j] = area <= iou * (areas - area)
