"""The road as a raster, so that a point's place on it is one look-up instead of a search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bools, Bytes, Floats, Floats32, Ints
from perception.lowest import lowest
from protocol.geometry import SE3
from protocol.roadmap import RoadMap

CELL_M = 0.5
MAX_CELLS = 8_000_000  # 9 bytes each


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Points (M, 3) on the road, map frame, and the road map's height below each (M,).

    `lowest` (V, 3) are x, y and height over the road of the lowest point of each square metre.
    """

    points: Floats32
    road_m: Floats32
    lowest: Floats32

    @classmethod
    def of(cls, points: Floats32, road_m: Floats32) -> Placed:
        """Finds the lowest points."""
        return cls(points, road_m, lowest(points, road_m))


def merge(parts: Sequence[Placed]) -> tuple[Floats32, Floats32]:
    """Returns all points (N, 3), in the order of the parts, and the road's height below (N,)."""
    points = [np.zeros((0, 3), np.float32), *(part.points for part in parts)]
    road_m = [np.zeros(0, np.float32), *(part.road_m for part in parts)]
    return np.concatenate(points), np.concatenate(road_m)


@dataclass(frozen=True, slots=True, eq=False)
class Roadway:
    """Cells of the map's plane: whether they belong to the road, its height and its direction.

    `inside`, `height_m` and `yaw_rad` are (rows, columns); rows go with y. Height and direction
    are those of the nearest lane and hold inside only.
    """

    origin_m: tuple[float, float]
    cell_m: float
    inside: Bytes
    height_m: Floats32
    yaw_rad: Floats32

    @classmethod
    def of(cls, road_map: RoadMap, *, margin_m: float) -> Roadway:
        """Draws the lanes, widened by the margin; a cell that the road touches belongs to it."""
        segments = lane_segments(road_map)
        reach_m = float(segments[:, 6].max()) + margin_m + 2 * CELL_M
        low = np.minimum(segments[:, 0:2], segments[:, 3:5]).min(axis=0) - reach_m
        high = np.maximum(segments[:, 0:2], segments[:, 3:5]).max(axis=0) + reach_m
        cell_m = max(CELL_M, float(np.sqrt(np.prod(high - low) / MAX_CELLS)))
        columns, rows = (int(n) for n in np.ceil((high - low) / cell_m))
        inside = np.zeros((rows, columns), np.uint8)
        height_m = np.zeros((rows, columns), np.float32)
        yaw_rad = np.zeros((rows, columns), np.float32)
        _draw(segments, low, cell_m, margin_m, inside, height_m, yaw_rad)
        return cls((float(low[0]), float(low[1])), cell_m, inside, height_m, yaw_rad)

    def place(
        self,
        points: Floats32,
        map_SE3_sensor: SE3,
        *,
        below_m: float,
        above_m: float,
    ) -> Placed:
        """Moves points (N, 3) into the map frame and keeps those on the road or over it.

        The paper geofences detections; no point elsewhere can be part of a vehicle that counts, so
        leaving it out here gives the same counts for a fraction of the work.
        """
        kept = np.empty_like(points)
        road_m = np.empty(len(points), np.float32)
        motion = np.column_stack([map_SE3_sensor.rotation, map_SE3_sensor.translation])
        grid = np.array([*self.origin_m, self.cell_m, -below_m, above_m], np.float64)
        count = _place(points, motion, grid, self.inside, self.height_m, kept, road_m)
        return Placed.of(kept[:count], road_m[:count])

    def yaw_at(self, points: Floats) -> Floats:
        """Returns the road's direction (N,) at points (N, 2 or 3); 0 off the road."""
        rows, columns, known = self._cells(points)
        return np.where(known, self.yaw_rad[rows, columns].astype(np.float64), 0.0)

    def height_at(self, points: Floats) -> Floats:
        """Returns the road's height (N,) at points (N, 2 or 3); 0 off the road."""
        rows, columns, known = self._cells(points)
        return np.where(known, self.height_m[rows, columns].astype(np.float64), 0.0)

    def contains(self, points: Floats | Floats32) -> Bools:
        """Whether points (N, 2 or 3) lie on the road."""
        rows, columns, known = self._cells(points)
        return np.asarray(known & (self.inside[rows, columns] > 0))

    def _cells(self, points: Floats | Floats32) -> tuple[Ints, Ints, Bools]:
        cells = np.floor((points[:, :2] - self.origin_m) / self.cell_m)
        shape = np.array(self.inside.shape[::-1])
        known: Bools = np.asarray(((cells >= 0) & (cells < shape)).all(axis=1))
        places = np.clip(cells, 0, shape - 1).astype(np.int64)
        return places[:, 1], places[:, 0], known


def lane_segments(road_map: RoadMap) -> Floats:
    """Returns the lanes' centrelines as segments (S, 7): two ends x, y, z and half the width."""
    parts = [
        np.column_stack(
            [lane.points[:-1], lane.points[1:], np.full(len(lane.points) - 1, lane.width_m / 2)]
        )
        for lane in road_map.lanes
        if len(lane.points) > 1
    ]
    return np.concatenate(parts)


@njit(
    "void(float64[:,::1], float64[::1], float64, float64, uint8[:,::1], float32[:,::1], "
    "float32[:,::1])",
    cache=True,
)
def _draw(
    segments: Floats,
    low: Floats,
    cell_m: float,
    margin_m: float,
    inside: Bytes,
    height_m: Floats32,
    yaw_rad: Floats32,
) -> None:
    """Fills the cells within reach of each segment from the nearest one."""
    rows, columns = inside.shape
    best = np.full((rows, columns), np.float32(np.inf))
    for index in range(segments.shape[0]):
        x0, y0, z0, x1, y1, z1, half_m = segments[index]
        reach_m = half_m + margin_m + 0.71 * cell_m
        dx, dy = x1 - x0, y1 - y0
        square = max(dx * dx + dy * dy, 1e-12)
        yaw = np.arctan2(dy, dx)
        first_row = max(int((min(y0, y1) - reach_m - low[1]) / cell_m), 0)
        last_row = min(int((max(y0, y1) + reach_m - low[1]) / cell_m), rows - 1)
        first_column = max(int((min(x0, x1) - reach_m - low[0]) / cell_m), 0)
        last_column = min(int((max(x0, x1) + reach_m - low[0]) / cell_m), columns - 1)
        for row in range(first_row, last_row + 1):
            y = low[1] + (row + 0.5) * cell_m
            for column in range(first_column, last_column + 1):
                x = low[0] + (column + 0.5) * cell_m
                along = min(max(((x - x0) * dx + (y - y0) * dy) / square, 0.0), 1.0)
                off_m = np.hypot(x - x0 - along * dx, y - y0 - along * dy)
                if off_m <= reach_m and off_m < best[row, column]:
                    best[row, column] = off_m
                    inside[row, column] = 1
                    height_m[row, column] = z0 + along * (z1 - z0)
                    yaw_rad[row, column] = yaw


@njit(
    "int64(float32[:,::1], float64[:,::1], float64[::1], uint8[:,::1], float32[:,::1], "
    "float32[:,::1], float32[::1])",
    cache=True,
    nogil=True,
)
def _place(
    points: Floats32,
    motion: Floats,
    grid: Floats,
    inside: Bytes,
    height_m: Floats32,
    kept: Floats32,
    road_m: Floats32,
) -> int:
    """Copies the points whose cell is inside and whose height lies in the band; counts them."""
    rows, columns = inside.shape
    x_m, y_m, cell_m, low_m, high_m = grid
    per_m = 1.0 / cell_m
    count = 0
    for index in range(points.shape[0]):
        u, v, w = points[index, 0], points[index, 1], points[index, 2]
        x = motion[0, 0] * u + motion[0, 1] * v + motion[0, 2] * w + motion[0, 3]
        y = motion[1, 0] * u + motion[1, 1] * v + motion[1, 2] * w + motion[1, 3]
        row, column = int(np.floor((y - y_m) * per_m)), int(np.floor((x - x_m) * per_m))
        if row < 0 or row >= rows or column < 0 or column >= columns or not inside[row, column]:
            continue
        z = motion[2, 0] * u + motion[2, 1] * v + motion[2, 2] * w + motion[2, 3]
        base_m = height_m[row, column]
        if low_m <= z - base_m <= high_m:
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
            road_m[count] = base_m
            count += 1
    return count
