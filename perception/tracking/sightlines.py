"""Sight lines of sensors: whether a vehicle that is not detected would have been.

A vehicle that is not detected may be hidden or gone. It is gone where a sensor has seen the ground
just before its place: nothing stands between them, and the vehicle's near side would have been hit.
Ground behind its place says less: low beams pass under a vehicle, high ones over its bonnet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Floats32
from perception.parallel import each

SECTORS = 2880
SLICES = 8  # of a box's middle part: before each of them ground may be seen
ENOUGH = 4.0  # before a quarter of a place ground is enough: few points lie on it
RINGS = 128
RING_M = 1.0
GROUND_M = 0.25  # over the road: what is lower is ground
MIDDLE = 0.5  # of a box's apparent width: ground beside it says nothing
BEFORE_M = 3.0  # ground so near before a box's near side says that nothing hides it


@dataclass(frozen=True, slots=True, eq=False)
class SightLines:
    """Polar maps of the ground that each of P sensors has seen, (P, `SECTORS`, `RINGS`).

    `sensors` (P, 3) are their places in the map frame.
    """

    sensors: Floats
    ground: Bools

    @classmethod
    def of(cls, sensors: Floats, lowest: Sequence[Floats32]) -> SightLines:
        """Draws the maps.

        Args:
            sensors: their places (P, 3), map frame.
            lowest: of each the lowest point of every square metre (V, 3): x, y, height over road.
        """
        ground = np.zeros((len(sensors), SECTORS, RINGS), np.bool_)

        def draw(index: int) -> None:
            _draw(lowest[index], sensors[index], ground[index])

        each(draw, range(len(lowest)))
        return cls(np.ascontiguousarray(sensors), ground)

    def plain(self, boxes: Floats) -> Floats:
        """Returns how surely a vehicle in each box (N, 7) would be in plain view, 0 to 1 (N,)."""
        return np.asarray(_plain(np.ascontiguousarray(boxes), self.sensors, self.ground))


@njit("void(float32[:,::1], float64[::1], boolean[:,::1])", cache=True, nogil=True)
def _draw(points: Floats32, sensor: Floats, ground: Bools) -> None:
    for index in range(points.shape[0]):
        if abs(points[index, 2]) < GROUND_M:
            x, y = points[index, 0] - sensor[0], points[index, 1] - sensor[1]
            ring = int(np.hypot(x, y) / RING_M)
            if ring < RINGS:
                sector = int(np.floor(np.arctan2(y, x) * (SECTORS / (2 * np.pi))))
                ground[sector % SECTORS, ring] = True


@njit("boolean(boolean[:,::1], int64, int64, int64, int64)", cache=True, nogil=True)
def _any_ground(ground: Bools, begin: int, end: int, first: int, last: int) -> bool:
    """Whether ground was seen in the sectors from `begin` to before `end`, in some rings."""
    for sector in range(begin, end):
        for ring in range(first, last + 1):
            if ground[sector % SECTORS, ring]:
                return True
    return False


@njit("float64(float64[::1], float64, float64, float64)", cache=True, nogil=True)
def _enters_m(box: Floats, x: float, y: float, bearing: float) -> float:
    """Returns how far from a sensor its ray enters a box (7,) whose middle is at x, y; or inf."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    ray_x, ray_y = np.cos(bearing), np.sin(bearing)
    enters_m, leaves_m = -np.inf, np.inf
    for at, step, half_m in (
        (cos * x + sin * y, cos * ray_x + sin * ray_y, box[3] / 2),
        (cos * y - sin * x, cos * ray_y - sin * ray_x, box[4] / 2),
    ):
        if abs(step) < 1e-9:
            if abs(at) > half_m:
                return np.inf
            continue
        one, other = (at - half_m) / step, (at + half_m) / step
        enters_m, leaves_m = max(enters_m, min(one, other)), min(leaves_m, max(one, other))
    return float(enters_m) if enters_m <= leaves_m else np.inf


@njit("float64[::1](float64[:,::1], float64[:,::1], boolean[:,:,::1])", cache=True, nogil=True)
def _plain(boxes: Floats, sensors: Floats, ground: Bools) -> Floats:
    """Takes of all sensors the one that saw most of the ground before each box's middle part."""
    shares = np.zeros(boxes.shape[0])
    per_rad = SECTORS / (2 * np.pi)
    for index in range(boxes.shape[0]):
        long_m, wide_m, yaw = boxes[index, 3], boxes[index, 4], boxes[index, 6]
        for sensor in range(sensors.shape[0]):
            x = boxes[index, 0] - sensors[sensor, 0]
            y = boxes[index, 1] - sensors[sensor, 1]
            range_m = np.hypot(x, y)
            if range_m < 2.0 or range_m > RINGS * RING_M:
                continue
            bearing = np.arctan2(y, x)
            turned = yaw - bearing
            half_m = MIDDLE / 2 * (abs(long_m * np.sin(turned)) + abs(wide_m * np.cos(turned)))
            low = int(np.ceil((bearing - half_m / range_m) * per_rad))
            high = int(np.floor((bearing + half_m / range_m) * per_rad))
            slices = min(SLICES, high - low)
            seen = 0
            for part in range(slices):
                begin = low + part * (high - low) // slices
                end = low + (part + 1) * (high - low) // slices
                near_m = _enters_m(boxes[index], x, y, (begin + end) / 2 / per_rad)
                if near_m < np.inf:
                    first = int(max(near_m - BEFORE_M, 0.0) / RING_M)
                    seen += _any_ground(ground[sensor], begin, end, first, int(near_m / RING_M) - 1)
            if slices > 0:
                shares[index] = max(shares[index], min(1.0, ENOUGH * seen / slices))
    return shares
