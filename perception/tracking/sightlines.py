"""Sight lines of sensors: visible ground rules out a vehicle that would have hidden it.

A vehicle that is not detected may be hidden or gone. It is gone where a sensor has seen the ground
behind its place: a beam that ends there has passed where the vehicle would be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Floats32
from perception.parallel import each

SECTORS = 2880
SLICES = 8  # of a box's middle part: through each of them ground may be seen
ENOUGH = 4.0  # a place of which a quarter was seen through is empty: few points lie on the ground
RINGS = 128
RING_M = 1.0
GROUND_M = 0.25  # over the road: what is lower is ground
MARGIN_M = 0.5  # behind a box's middle, where the ground is no part of a wheel


@dataclass(frozen=True, slots=True, eq=False)
class SightLines:
    """Polar maps of the ground that each of P sensors has seen, (P, `SECTORS`, `RINGS`).

    `sensors` (P, 3) are their places in the map frame, `heights_m` (P,) those over the road.
    """

    sensors: Floats
    heights_m: Floats
    ground: Bools

    @classmethod
    def of(cls, sensors: Floats, lowest: Sequence[Floats32], heights_m: Floats) -> SightLines:
        """Draws the maps.

        Args:
            sensors: their places (P, 3), map frame.
            lowest: of each the lowest point of every square metre (V, 3): x, y, height over road.
            heights_m: of each over the road (P,).
        """
        ground = np.zeros((len(sensors), SECTORS, RINGS), np.bool_)

        def draw(index: int) -> None:
            _draw(lowest[index], sensors[index], ground[index])

        each(draw, range(len(lowest)))
        return cls(np.ascontiguousarray(sensors), heights_m, ground)

    def empty(self, boxes: Floats) -> Floats:
        """Returns how surely each box (N, 7) is empty, 0 to 1: the ground seen through it (N,).

        0 is none. What was seen beside a box does not count.
        """
        return np.asarray(
            _empty(np.ascontiguousarray(boxes), self.sensors, self.heights_m, self.ground)
        )


@njit("void(float32[:,::1], float64[::1], boolean[:,::1])", cache=True, nogil=True)
def _draw(points: Floats32, sensor: Floats, ground: Bools) -> None:
    for index in range(points.shape[0]):
        if abs(points[index, 2]) < GROUND_M:
            x, y = points[index, 0] - sensor[0], points[index, 1] - sensor[1]
            ring = int(np.hypot(x, y) / RING_M)
            if ring < RINGS:
                ground[int(np.arctan2(y, x) * (SECTORS / (2 * np.pi))) % SECTORS, ring] = True


@njit("boolean(boolean[:,::1], int64, int64, int64, int64)", cache=True, nogil=True)
def _any_ground(ground: Bools, begin: int, end: int, first: int, last: int) -> bool:
    """Whether ground was seen in the sectors from `begin` to before `end`, in some rings."""
    for sector in range(begin, end):
        for ring in range(first, last + 1):
            if ground[sector % SECTORS, ring]:
                return True
    return False


@njit(
    "float64[::1](float64[:,::1], float64[:,::1], float64[::1], boolean[:,:,::1])",
    cache=True,
    nogil=True,
)
def _empty(boxes: Floats, sensors: Floats, heights_m: Floats, ground: Bools) -> Floats:
    """Takes of all sensors the one that saw most through each box's middle part."""
    shares = np.zeros(boxes.shape[0])
    for index in range(boxes.shape[0]):
        long_m, wide_m, high_m, yaw = boxes[index, 3:7]
        for sensor in range(sensors.shape[0]):
            x = boxes[index, 0] - sensors[sensor, 0]
            y = boxes[index, 1] - sensors[sensor, 1]
            range_m = np.hypot(x, y)
            if range_m < 2.0 or range_m > RINGS * RING_M:
                continue
            bearing = np.arctan2(y, x)
            turned = yaw - bearing
            half_m = 0.35 * (abs(long_m * np.sin(turned)) + abs(wide_m * np.cos(turned)))
            over_m = heights_m[sensor] - 0.7 * high_m
            shadow_m = range_m * heights_m[sensor] / over_m if over_m > 0.1 else np.inf
            first = int((range_m + MARGIN_M) / RING_M)
            last = int(min(shadow_m, range_m + 25.0, RINGS * RING_M - 1) / RING_M)
            low = int(np.ceil((bearing - half_m / range_m) * (SECTORS / (2 * np.pi))))
            high = int(np.floor((bearing + half_m / range_m) * (SECTORS / (2 * np.pi))))
            slices = min(SLICES, high - low)
            through = 0
            for part in range(slices):
                begin = low + part * (high - low) // slices
                end = low + (part + 1) * (high - low) // slices
                through += _any_ground(ground[sensor], begin, end, first, last)
            if slices > 0:
                shares[index] = max(shares[index], min(1.0, ENOUGH * through / slices))
    return shares
