"""Extrinsic calibration: refines a first guess by registering overlapping clouds.

Each sensor is levelled by the ground around it, which gives roll, pitch and height. Heading and
position are then those that put most upright points over those of the first sensor: a search around
the guess, ever finer. It needs sensors with overlapping fields of view.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from protocol.errors import ConfigError
from protocol.geometry import SE3, Floats

_NEAR_M = 20.0
_ON_PLANE_M = 0.08
_TRIES = 400
_LEAST_SHARE = 0.1  # of the near points, on a plane that is to be the ground
_STANDS_M = (0.3, 3.0)  # over the ground: what is compared
_CELL_M = 0.2
_HALF_M = 60.0  # of the grid
_ROUNDS = ((25.0, 1.0, 2.5, 0.5), (3.0, 0.5, 0.5, 0.1), (0.5, 0.1, 0.1, 0.02))
"""Search: largest error of the heading (deg) and the position (m), and the steps of both."""


@dataclass(frozen=True, slots=True, eq=False)
class _Levelled:
    """A sensor's frame turned upright over the ground: `level_SE3_sensor`, and points (N, 3)."""

    level_SE3_sensor: SE3
    points: Floats


def refined(guess: Mapping[str, SE3], clouds: Mapping[str, Floats]) -> dict[str, SE3]:
    """Returns `vehicle_SE3_sensor` by sensor; that of the first stays as it is.

    Args:
        guess: the same, as far as it is known.
        clouds: points (N, 3) of each sensor at one moment, in its own frame.

    Raises:
        ConfigError: a sensor sees no ground.
    """
    levelled = {name: _level(name, clouds[name]) for name in guess}
    first = next(iter(guess))
    vehicle_SE3_level = guess[first] @ levelled[first].level_SE3_sensor.inverse()
    grid = occupied(_standing(levelled[first].points))
    found = {first: guess[first]}
    for name in [other for other in guess if other != first]:
        guessed = vehicle_SE3_level.inverse() @ guess[name]
        start = np.array([*guessed.translation[:2], guess[name].as_pose()[5]])
        place = search(_standing(levelled[name].points), grid, start)
        level_SE3_level = SE3.from_pose([place[0], place[1], 0, 0, 0, place[2]])
        found[name] = vehicle_SE3_level @ level_SE3_level @ levelled[name].level_SE3_sensor
    return found


def _level(name: str, points: Floats) -> _Levelled:
    points = points.astype(np.float64)
    near = points[np.linalg.norm(points, axis=1) < _NEAR_M]
    up, height_m, share = ground_plane(near)
    if share < _LEAST_SHARE:
        raise ConfigError(f"the sensor {name} sees no ground to be levelled by")
    # The forward axis keeps its heading: the guess gives the yaw.
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    if np.linalg.norm(ahead) < 0.1:
        raise ConfigError(f"the sensor {name} looks straight up or down: it has no heading")
    ahead /= np.linalg.norm(ahead)
    rotation = np.stack([ahead, np.cross(up, ahead), up])
    upright = SE3(rotation, np.array([0.0, 0.0, height_m]))
    return _Levelled(upright, upright.apply(points))


def ground_plane(points: Floats) -> tuple[Floats, float, float]:
    """Returns the normal (3,) of the plane with most points (N, 3), how far below it lies, a share.

    That of the points; 0 where there is none.
    """
    rng = np.random.default_rng(1)
    best = (np.array([0.0, 0.0, 1.0]), 0.0, 0.0)
    if len(points) < 3:
        return best
    for _ in range(_TRIES):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-6:
            continue
        normal = normal / length * (-1.0 if normal @ a > 0 else 1.0)  # towards the sensor
        share = float((np.abs(points @ normal - normal @ a) < _ON_PLANE_M).mean())
        if share > best[2] and normal[2] > 0:
            best = (normal, -float(normal @ a), share)
    return best


def _standing(points: Floats) -> Floats:
    """Returns the places (M, 2) of upright points within the grid, one of each cell."""
    return cells(points[(points[:, 2] > _STANDS_M[0]) & (points[:, 2] < _STANDS_M[1]), :2])


def cells(places: Floats) -> Floats:
    """Returns the middles (M, 2) of the grid's cells in which places (N, 2) lie."""
    inside = places[(np.abs(places) < _HALF_M).all(axis=1)]
    return np.asarray(np.unique(np.floor(inside / _CELL_M), axis=0) * _CELL_M + _CELL_M / 2)


def occupied(places: Floats) -> Floats:
    """Returns a grid of occupied places, 1 there and less beside them."""
    side = round(2 * _HALF_M / _CELL_M)
    grid = np.zeros((side, side))
    cells = np.floor((places + _HALF_M) / _CELL_M).astype(np.int64)
    grid[cells[:, 0], cells[:, 1]] = 1.0
    beside = grid.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            beside = np.maximum(beside, 0.5 * np.roll(grid, step, axis=axis))
    return beside


def search(places: Floats, grid: Floats, start: Floats) -> Floats:
    """Returns x, y, yaw (3,) near the start at which most places lie on occupied cells."""
    best = start
    for turn_deg, step_deg, off_m, step_m in _ROUNDS:
        turns = np.radians(np.arange(-turn_deg, turn_deg + step_deg / 2, step_deg))
        shifts = np.arange(-off_m, off_m + step_m / 2, step_m)
        tried = [
            best + np.array([dx, dy, turn]) for turn in turns for dx in shifts for dy in shifts
        ]
        scores = [_score(places, grid, pose) for pose in tried]
        best = tried[int(np.argmax(scores))]
    return best


def _score(places: Floats, grid: Floats, pose: Floats) -> float:
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    x = cosine * places[:, 0] - sine * places[:, 1] + pose[0] + _HALF_M
    y = sine * places[:, 0] + cosine * places[:, 1] + pose[1] + _HALF_M
    rows, columns = (x / _CELL_M).astype(np.int64), (y / _CELL_M).astype(np.int64)
    inside = (rows >= 0) & (columns >= 0) & (rows < grid.shape[0]) & (columns < grid.shape[1])
    return float(grid[rows[inside], columns[inside]].sum())
