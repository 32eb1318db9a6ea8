"""The ground: heights anywhere, and how a body stands on it."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.geometry import Floats
from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.noise import stream
from sensing.relief import road_relief, undulation

CELL_M = 4.0
MARGIN_M = 128.0  # as far beyond the road as a sensor on it sees
_MAX_NODES = 4_000_000
_HALF_WHEELBASE_M, _HALF_TRACK_M = 1.35, 0.75


class Terrain:
    """A grid of heights, as the scene's ground mesh shows it.

    Attributes:
        origin: x, y (2,) of the grid's first node, in the map frame.
        cell_m: distance between nodes.
        nodes: heights (rows along y, columns along x) in m, read-only.
    """

    def __init__(self, road_map: RoadMap, config: SceneConfig, seed: int) -> None:
        flat = np.concatenate([lane.points[:, :2] for lane in road_map.lanes])
        low, high = flat.min(axis=0) - MARGIN_M, flat.max(axis=0) + MARGIN_M
        self.cell_m = CELL_M
        while np.prod((high - low) / self.cell_m) > _MAX_NODES:
            self.cell_m *= 2
        self.origin: Floats = np.floor(low / self.cell_m) * self.cell_m
        columns, rows = (int(n) + 2 for n in (high - self.origin) / self.cell_m)
        shape = (rows, columns)
        road = road_relief(road_map, self.origin, self.cell_m, shape)
        waves = undulation(self.origin, self.cell_m, shape, stream(seed, "terrain"))
        self.nodes: Floats = np.ascontiguousarray(road + waves * config.terrain_amplitude_m)
        self.nodes.setflags(write=False)

    def height_m(self, xy: npt.ArrayLike) -> Floats:
        """Returns the ground's height at places (N, 2); beyond the grid, that of its border."""
        places = np.ascontiguousarray(np.asarray(xy, np.float64).reshape(-1, 2))
        result = np.empty(len(places))
        _heights(self.nodes, self.origin, self.cell_m, places, result)
        return result

    def body_poses(self, x: npt.ArrayLike, y: npt.ArrayLike, yaw: npt.ArrayLike) -> Floats:
        """Returns poses (N, 6) of bodies whose four wheels stand on the ground.

        Args:
            x: of the footprints' centres (N,), m.
            y: the same.
            yaw: headings (N,), rad CCW from +x.
        """
        plane = np.ascontiguousarray(np.column_stack([x, y, yaw]), np.float64)
        result = np.empty((len(plane), 6))
        _stand(self.nodes, self.origin, self.cell_m, plane, result)
        return result


_GRID = "Array(float64, 2, 'C', readonly=True), float64[::1], float64"


@njit(f"float64({_GRID}, float64, float64)", cache=True)
def _height(nodes: Floats, origin: Floats, cell_m: float, x: float, y: float) -> float:
    """Interpolates within the triangle of the ground mesh: cells are cut from low to high x, y."""
    rows, columns = nodes.shape
    u = min(max((x - origin[0]) / cell_m, 0.0), columns - 1.000001)
    v = min(max((y - origin[1]) / cell_m, 0.0), rows - 1.000001)
    i, j = int(v), int(u)
    u -= j
    v -= i
    low, high = nodes[i, j], nodes[i + 1, j + 1]
    if u >= v:
        corner = nodes[i, j + 1]
        return float(low + u * (corner - low) + v * (high - corner))
    corner = nodes[i + 1, j]
    return float(low + v * (corner - low) + u * (high - corner))


@njit(f"void({_GRID}, Array(float64, 2, 'C', readonly=True), float64[::1])", cache=True)
def _heights(nodes: Floats, origin: Floats, cell_m: float, xy: Floats, result: Floats) -> None:
    for n in range(len(xy)):
        result[n] = _height(nodes, origin, cell_m, xy[n, 0], xy[n, 1])


@njit(f"void({_GRID}, float64[:,::1], float64[:,::1])", cache=True)
def _stand(nodes: Floats, origin: Floats, cell_m: float, plane: Floats, result: Floats) -> None:
    for n in range(len(plane)):
        x, y, yaw = plane[n, 0], plane[n, 1], plane[n, 2]
        ax, ay = math.cos(yaw) * _HALF_WHEELBASE_M, math.sin(yaw) * _HALF_WHEELBASE_M
        bx, by = -math.sin(yaw) * _HALF_TRACK_M, math.cos(yaw) * _HALF_TRACK_M
        front_left = _height(nodes, origin, cell_m, x + ax + bx, y + ay + by)
        front_right = _height(nodes, origin, cell_m, x + ax - bx, y + ay - by)
        rear_left = _height(nodes, origin, cell_m, x - ax + bx, y - ay + by)
        rear_right = _height(nodes, origin, cell_m, x - ax - bx, y - ay - by)
        climb = (front_left + front_right - rear_left - rear_right) / (4 * _HALF_WHEELBASE_M)
        bank = (front_left + rear_left - front_right - rear_right) / (4 * _HALF_TRACK_M)
        result[n, 0] = x
        result[n, 1] = y
        result[n, 2] = (front_left + front_right + rear_left + rear_right) / 4
        result[n, 3] = math.atan(bank * math.cos(math.atan(climb)))
        result[n, 4] = -math.atan(climb)  # nose up is negative about y, which points left
        result[n, 5] = yaw
