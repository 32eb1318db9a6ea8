"""What the network should have said of a window: which anchors are vehicles, and their terms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Floats32, Ints32
from perception.pillars.config import ANCHOR_YAWS, STRIDE, PillarsConfig
from perception.pillars.network import middle_of, terms_of
from perception.pillars.windows import Window

VEHICLE_IOU, NOTHING_IOU = 0.6, 0.45  # of Lang et al. 2019; in between an anchor does not count
DOUBTFUL_IOU = 0.1  # of a vehicle too faint to be asked for
NOBODY = -1


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """By anchor, directions first: `owner` (A,) is -1 for none; `counts` (A,) if it is judged.

    `place` (V,) are the anchors that are vehicles, and `terms` (V, 7) theirs.
    """

    is_vehicle: Bools
    counts: Bools
    place: Ints32
    terms: Floats32


def targets_of(boxes: Floats, sure: Bools, window: Window, config: PillarsConfig) -> Targets:
    """Assigns anchors to boxes (K, 7), z over the road; those not `sure` (K,) are not judged."""
    rows, columns = (side // STRIDE for side in window.size)
    overlap = np.zeros(ANCHOR_YAWS * rows * columns, np.float32)
    owner = np.full(len(overlap), NOBODY, np.int32)
    step_m = STRIDE * config.cell_m
    grid = np.array([*window.low, step_m, *config.anchor_m[:2]], np.float64)
    _assign(np.ascontiguousarray(boxes, np.float64), grid, rows, columns, overlap, owner)
    sure_owner = (owner >= 0) & np.append(sure, False)[owner]
    is_vehicle = sure_owner & (overlap >= VEHICLE_IOU)
    _claim_best(overlap, owner, len(boxes), is_vehicle, sure)
    faint = (owner >= 0) & ~sure_owner & (overlap >= DOUBTFUL_IOU)
    counts = is_vehicle | ~((overlap >= NOTHING_IOU) | faint)
    place = np.flatnonzero(is_vehicle).astype(np.int32)
    kind, cell = np.divmod(place, rows * columns)
    middle = middle_of(cell, window, config)
    terms = terms_of(boxes[owner[place]], middle, kind, config)
    return Targets(is_vehicle, counts, place, terms)


@njit(
    "void(float64[:,::1], float64[::1], int64, int64, float32[::1], int32[::1])",
    cache=True,
    nogil=True,
)
def _assign(
    boxes: Floats, grid: Floats, rows: int, columns: int, overlap: Floats32, owner: Ints32
) -> None:
    """Gives each anchor the box it overlaps most, both laid along the axes."""
    low_x, low_y, step_m, length_m, width_m = grid
    for index in range(boxes.shape[0]):
        x, y, long_m, wide_m = boxes[index, 0], boxes[index, 1], boxes[index, 3], boxes[index, 4]
        if abs(np.sin(boxes[index, 6])) > abs(np.cos(boxes[index, 6])):
            long_m, wide_m = wide_m, long_m
        reach_m = (max(long_m, wide_m) + length_m) / 2
        first_row = max(int((y - reach_m - low_y) / step_m), 0)
        last_row = min(int((y + reach_m - low_y) / step_m), rows - 1)
        first_column = max(int((x - reach_m - low_x) / step_m), 0)
        last_column = min(int((x + reach_m - low_x) / step_m), columns - 1)
        for row in range(first_row, last_row + 1):
            off_y = abs(low_y + (row + 0.5) * step_m - y)
            for column in range(first_column, last_column + 1):
                off_x = abs(low_x + (column + 0.5) * step_m - x)
                for kind in range(2):
                    along = length_m if kind == 0 else width_m
                    across = width_m if kind == 0 else length_m
                    common_x = min(min(long_m, along), (long_m + along) / 2 - off_x)
                    common_y = min(min(wide_m, across), (wide_m + across) / 2 - off_y)
                    if common_x <= 0 or common_y <= 0:
                        continue
                    area = common_x * common_y
                    iou = area / (long_m * wide_m + length_m * width_m - area)
                    place = (kind * rows + row) * columns + column
                    if iou > overlap[place]:
                        overlap[place] = iou
                        owner[place] = index


@njit("void(float32[::1], int32[::1], int64, boolean[::1], boolean[::1])", cache=True, nogil=True)
def _claim_best(
    overlap: Floats32, owner: Ints32, boxes: int, is_vehicle: Bools, sure: Bools
) -> None:
    """Makes each sure box's best anchor a vehicle, so that none is without."""
    best = np.full(boxes, -1, np.int64)
    for place in range(owner.size):
        index = owner[place]
        if (
            index >= 0
            and sure[index]
            and (best[index] < 0 or overlap[place] > overlap[best[index]])
        ):
            best[index] = place
    for index in range(boxes):
        if best[index] >= 0:
            is_vehicle[best[index]] = True
