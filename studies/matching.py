"""One-to-one matches of detections with the vehicles that they are of."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from perception.arrays import Floats

MARGIN_M = 0.5


def match(
    centres_m: Floats, vehicles: Floats, sizes_m: Floats, margin_m: float = MARGIN_M
) -> list[tuple[int, int]]:
    """Returns pairs (detection, vehicle): a detection's centre lies in the vehicle's footprint.

    The nearest pairs are taken first, and nobody twice. Ties are broken by where things are, never
    by their order, so that a permutation of the input gives the same pairs.

    Args:
        centres_m: (N, 2) x, y of the detections.
        vehicles: (M, 3) x, y of the footprints' centres and yaw in rad.
        sizes_m: (M, 2) length and width.
        margin_m: the footprint grows by this on every side.
    """
    offset = centres_m[:, None, :] - vehicles[None, :, :2]
    cos, sin = np.cos(vehicles[:, 2]), np.sin(vehicles[:, 2])
    along = np.abs(offset[..., 0] * cos + offset[..., 1] * sin)
    across = np.abs(offset[..., 1] * cos - offset[..., 0] * sin)
    reach_m = sizes_m / 2 + margin_m
    detection, vehicle = np.nonzero((along <= reach_m[:, 0]) & (across <= reach_m[:, 1]))
    distance = np.hypot(along, across)[detection, vehicle]
    ties = (*vehicles[vehicle].T, *centres_m[detection].T)
    return _greedy(detection, vehicle, np.lexsort((*ties, distance)))


def _greedy(
    detection: npt.NDArray[np.int64], vehicle: npt.NDArray[np.int64], order: npt.NDArray[np.int64]
) -> list[tuple[int, int]]:
    seen_detections: set[int] = set()
    seen_vehicles: set[int] = set()
    pairs = []
    for d, v in zip(detection[order].tolist(), vehicle[order].tolist(), strict=True):
        if d not in seen_detections and v not in seen_vehicles:
            seen_detections.add(d)
            seen_vehicles.add(v)
            pairs.append((d, v))
    return pairs
