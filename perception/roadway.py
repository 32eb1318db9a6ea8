"""Raster of the road: height and direction of the road at a point by one look-up."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Floats32, Ints, Ints32
from perception.votes import BLOCK, TABLE, lowest, table
from protocol.geometry import SE3
from protocol.roadmap import RoadMap

LEVEL_M = 3.5  # lanes farther above one another are on different levels
MOST_DECKS = 3  # over one another; of more, the lowest
DECK_BELOW_M, SLAB_M = 0.4, 1.5  # below a deck's road: still on it; from there on, under the bridge
CELL_M = 0.5  # two make a metre, the side of the squares that vote
MAX_CELLS = 8_000_000  # 8 bytes each


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
    """Cells of the map's plane: the road's height, NaN off the road, and its direction.

    `height_m` and `yaw_rad` are (rows, columns); rows go with y. Both are those of the nearest
    lane. Where lanes pass over others, those are the lowest; the others are in `decks_m` and
    `deck_yaws_rad` (levels, rows, columns), upwards, NaN elsewhere. The outermost cells lie off the
    road.
    """

    origin_m: tuple[float, float]
    cell_m: float
    height_m: Floats32
    yaw_rad: Floats32
    decks_m: Floats32
    deck_yaws_rad: Floats32

    @classmethod
    def of(cls, road_map: RoadMap, *, margin_m: float) -> Roadway:
        """Draws the lanes, widened by the margin; a cell that the road touches belongs to it."""
        segments = lane_segments(road_map)
        reach_m = float(segments[:, 6].max()) + margin_m + 2 * CELL_M
        low = np.minimum(segments[:, 0:2], segments[:, 3:5]).min(axis=0) - reach_m
        high = np.maximum(segments[:, 0:2], segments[:, 3:5]).max(axis=0) + reach_m
        cell_m = max(CELL_M, float(np.sqrt(np.prod(high - low) / MAX_CELLS)))
        low = np.floor(low)  # squares lie as those of `perception.votes`
        columns, rows = (int(n) for n in np.ceil((high - low) / cell_m))
        for levels in range(1, MOST_DECKS + 2):
            heights_m = np.full((levels, rows, columns), np.nan, np.float32)
            yaws_rad = np.zeros_like(heights_m)
            if not _draw(segments, low, cell_m, margin_m, heights_m, yaws_rad):
                break
        if levels > 1:
            upwards = np.argsort(heights_m, axis=0)
            heights_m, yaws_rad = (
                np.take_along_axis(layers, upwards, axis=0) for layers in (heights_m, yaws_rad)
            )
        for edge in (heights_m[:, 0], heights_m[:, -1], heights_m[..., 0], heights_m[..., -1]):
            edge[:] = np.nan
        place = float(low[0]), float(low[1])
        return cls(place, cell_m, heights_m[0], yaws_rad[0], heights_m[1:], yaws_rad[1:])

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
        room = len(points) + 1  # one is written before it is known to stay
        kept, road_m = np.empty((room, 3), np.float32), np.empty(room, np.float32)
        motion = np.column_stack([map_SE3_sensor.rotation, map_SE3_sensor.translation])
        grid = np.array([*self.origin_m, 1 / self.cell_m, -below_m, above_m], np.float32)
        rows, columns = self.height_m.shape
        squares = table(((rows + 1) // 2) * ((columns + 1) // 2))
        count, votes = _place(
            points,
            motion.astype(np.float32),
            grid,
            self.height_m,
            self.decks_m if len(self.decks_m) else None,
            squares,
            kept,
            road_m,
        )
        return Placed(kept[:count], road_m[:count], votes)

    def yaw_at(self, points: Floats) -> Floats:
        """Returns the road's direction (N,) at points (N, 2 or 3); 0 off the road."""
        rows, columns, known = self._cells(points)
        found = np.where(known, self.yaw_rad[rows, columns].astype(np.float64), 0.0)
        for level, on_deck in self._on_decks(points, rows, columns):
            found[on_deck] = self.deck_yaws_rad[level, rows[on_deck], columns[on_deck]]
        return found

    def height_at(self, points: Floats) -> Floats:
        """Returns the road's height (N,) at points (N, 2 or 3); 0 off the road.

        Of roads over one another, the highest that lies below a point, the lowest without heights.
        """
        rows, columns, known = self._cells(points)
        found = np.where(known, self.height_m[rows, columns].astype(np.float64), 0.0)
        for level, on_deck in self._on_decks(points, rows, columns):
            found[on_deck] = self.decks_m[level, rows[on_deck], columns[on_deck]]
        return found

    def contains(self, points: Floats | Floats32) -> Bools:
        """Whether points (N, 2 or 3) lie on the road."""
        return self._cells(points)[2]

    def _on_decks(self, points: Floats, rows: Ints, columns: Ints) -> Iterator[tuple[int, Bools]]:
        """Yields each level of decks, and which points (N, 3) are not below it."""
        if points.shape[1] > 2:
            for level, deck_m in enumerate(self.decks_m):
                yield level, points[:, 2] >= deck_m[rows, columns] - DECK_BELOW_M

    def _cells(self, points: Floats | Floats32) -> tuple[Ints, Ints, Bools]:
        """Returns rows, columns and whether they belong to the road (N,)."""
        places = np.ascontiguousarray(points, np.float64)
        rows, columns = _cells(places, *self.origin_m, self.cell_m, *self.height_m.shape)
        return rows, columns, ~np.isnan(self.height_m[rows, columns])


@njit(
    "UniTuple(int64[::1], 2)(float64[:,::1], float64, float64, float64, int64, int64)",
    cache=True,
    nogil=True,
)
def _cells(
    points: Floats, x_m: float, y_m: float, cell_m: float, rows: int, columns: int
) -> tuple[Ints, Ints]:
    """Returns the row and the column (N,) of points (N, 2 or 3), of outer ones those nearest."""
    row_of, column_of = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    for index in range(len(points)):
        column = np.floor((points[index, 0] - x_m) / cell_m)
        row = np.floor((points[index, 1] - y_m) / cell_m)
        column_of[index] = min(max(column, 0.0), columns - 1.0)
        row_of[index] = min(max(row, 0.0), rows - 1.0)
    return row_of, column_of


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
    "int64(float64[:,::1], float64[::1], float64, float64, float32[:,:,::1], float32[:,:,::1])",
    cache=True,
    nogil=True,
)
def _draw(
    segments: Floats,
    low: Floats,
    cell_m: float,
    margin_m: float,
    heights_m: Floats32,
    yaws_rad: Floats32,
) -> int:
    """Fills the cells within reach of each segment from the nearest one of each level.

    Returns how often there were more levels than layers (levels, rows, columns).
    """
    levels, rows, columns = heights_m.shape
    best = np.full((levels, rows, columns), np.float32(np.inf))
    left = 0
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
                if off_m > reach_m:
                    continue
                z, level = z0 + along * (z1 - z0), 0
                while level < levels and abs(z - heights_m[level, row, column]) > LEVEL_M:
                    level += 1
                if level == levels:
                    left += 1
                elif off_m < best[level, row, column]:
                    best[level, row, column] = off_m
                    heights_m[level, row, column] = z
                    yaws_rad[level, row, column] = yaw
    return left


@njit(
    "float32(float32, uint64, uint64, float32[:,::1], float32[:,:,::1])",
    cache=True,
    nogil=True,
    inline="always",
)
def road_below(
    z: float, row: np.uint64, column: np.uint64, height_m: Floats32, decks_m: Floats32
) -> np.float32:
    """Returns the height of the road that a height belongs to in a cell; NaN off the road.

    And within a bridge: what is there is neither on the road over it nor on the one below.
    """
    base_m: np.float32 = height_m[row, column]
    for level in range(decks_m.shape[0]):
        over_m = z - decks_m[level, row, column]
        base_m = np.float32(np.nan) if over_m >= -np.float32(SLAB_M) else base_m
        base_m = decks_m[level, row, column] if over_m >= -np.float32(DECK_BELOW_M) else base_m
    return base_m


@njit(
    "Tuple((float32[:,::1], int32[:,::1]))"
    "(float32[:,::1], float32[:,::1], float32[::1], UniTuple(int64, 2))",
    cache=True,
    nogil=True,
)
def _move(
    points: Floats32, motion: Floats32, grid: Floats32, shape: tuple[int, int]
) -> tuple[Floats32, Ints32]:
    """Returns where a block's points (B, 3) lie in the map (3, B), and their cells and squares.

    Nothing is looked up, and what is written is new, so that a core works on eight points at once.
    """
    assert points.shape[1] == 3
    moved = np.empty((3, points.shape[0]), np.float32)
    places = np.empty((2, points.shape[0]), np.int32)
    x_m, y_m, per_m = grid[0], grid[1], grid[2]
    last_row, last_column = np.float32(shape[0] - 1), np.float32(shape[1] - 1)
    wide, across = np.int32(shape[1]), np.int32((shape[1] + 1) // 2)
    none = np.float32(0)
    xu, xv, xw, x0 = motion[0]
    yu, yv, yw, y0 = motion[1]
    zu, zv, zw, z0 = motion[2]
    for index in range(points.shape[0]):
        u, v, w = points[index, 0], points[index, 1], points[index, 2]
        x, y = xu * u + xv * v + xw * w + x0, yu * u + yv * v + yw * w + y0
        at_x, at_y = (x - x_m) * per_m, (y - y_m) * per_m
        at_x = at_x if at_x > none else none
        at_x = at_x if at_x < last_column else last_column
        at_y = at_y if at_y > none else none
        at_y = at_y if at_y < last_row else last_row
        row, column = np.int32(at_y), np.int32(at_x)
        moved[0, index], moved[1, index] = x, y
        moved[2, index] = zu * u + zv * v + zw * w + z0
        places[0, index] = row * wide + column
        places[1, index] = (row >> 1) * across + (column >> 1)
    return moved, places


@njit(
    [
        "Tuple((int64, float32[:,::1]))(float32[:,::1], float32[:,::1], float32[::1], "
        f"float32[:,::1], {decks}, {TABLE}, float32[:,::1], float32[::1])"
        for decks in ("none", "float32[:,:,::1]")
    ],
    cache=True,
    nogil=True,
)
def _place(
    points: Floats32,
    motion: Floats32,
    grid: Floats32,
    height_m: Floats32,
    decks_m: Floats32 | None,
    squares: tuple[Floats32, Ints32, Ints32],
    kept: Floats32,
    road_m: Floats32,
) -> tuple[int, Floats32]:
    """Copies the points over road cells whose height lies in the band; counts them, and votes.

    Choices of two values take no branch, which would be mispredicted too often.
    """
    assert points.shape[1] == kept.shape[1] == 3
    low_m, high_m = grid[3], grid[4]
    square_low_m, square_index, touched = squares
    nowhere, heights_m = np.float32(np.inf), height_m.reshape(-1)
    width = np.int32(height_m.shape[1])
    count, found = np.uint64(0), np.uint64(0)
    for begin in range(0, points.shape[0], BLOCK):
        some = points[begin : begin + BLOCK]
        moved, places = _move(some, motion, grid, height_m.shape)
        for point in range(some.shape[0]):
            index = np.uint64(point)
            x, y, z, cell = moved[0, index], moved[1, index], moved[2, index], places[0, index]
            base_m = heights_m[np.uint64(cell)]
            if decks_m is not None:
                row, column = np.uint64(cell // width), np.uint64(cell % width)
                base_m = road_below(z, row, column, height_m, decks_m)
            kept[count, 0], kept[count, 1], kept[count, 2], road_m[count] = x, y, z, base_m
            over_m = z - base_m
            stays = (low_m <= over_m) & (over_m <= high_m)
            square = np.uint64(places[1, index])
            if (over_m if stays else nowhere) < square_low_m[square]:
                touched[found] = square
                found += np.uint64(square_low_m[square] == nowhere)
                square_low_m[square], square_index[square] = over_m, count
            count += np.uint64(stays)
    votes = np.empty((int(found), 3), np.float32)
    for vote in range(found):
        square = np.uint64(touched[vote])
        for axis in range(2):
            votes[vote, axis] = kept[np.uint64(square_index[square]), axis]
        votes[vote, 2], square_low_m[square] = square_low_m[square], nowhere
    return int(count), votes
