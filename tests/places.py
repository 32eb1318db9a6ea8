"""Scenes for LiDARs from elsewhere: flat ground, a wall, and vehicles as boxes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from perception.arrays import Floats
from protocol.geometry import SE3

CAR_M = (4.4, 1.8, 1.5)


def scene(cars: Sequence[tuple[float, float, float]] = (), *, walls: bool = True) -> Floats:
    """Returns points (N, 3) in the map frame; cars are x, y, yaw in rad. The ground is z = 0."""
    rng = np.random.default_rng(5)
    steps = np.arange(-30, 30, 0.25)
    ground = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    parts = [np.column_stack([ground, np.zeros(len(ground))])]
    if walls:
        along = rng.uniform(-25, 25, 6000)
        parts.append(np.column_stack([along, np.full(6000, 14.0), rng.uniform(0, 4, 6000)]))
        along = rng.uniform(-12, 18, 4000)
        parts.append(np.column_stack([np.full(4000, 22.0), along, rng.uniform(0, 4, 4000)]))
    parts += [_car(*car, rng) for car in cars]
    return np.concatenate(parts) + rng.normal(0, 0.01, (sum(map(len, parts)), 3))


DIRECTION_DEG = 0.5
DEEP_M = 0.6  # of what is seen in one direction


def seen(points: Floats, map_SE3_sensor: SE3) -> Floats:
    """Returns points of the map in a sensor's frame, without those that others hide."""
    local = map_SE3_sensor.inverse().apply(points)
    range_m = np.linalg.norm(local, axis=1)
    up = np.arcsin(local[:, 2] / np.maximum(range_m, 1e-9))
    angles = np.degrees(np.stack([np.arctan2(local[:, 1], local[:, 0]), up], -1))
    _, direction = np.unique(np.floor(angles / DIRECTION_DEG), axis=0, return_inverse=True)
    nearest_m = np.full(direction.max() + 1, np.inf)
    np.minimum.at(nearest_m, direction, range_m)
    return local[range_m <= nearest_m[direction] + DEEP_M]


def write_bin(path: Path, points: Floats) -> None:
    """Writes KITTI's rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.column_stack([points, np.zeros(len(points))]).astype("<f4")
    path.write_bytes(rows.tobytes())


def write_pcd(path: Path, points: Floats) -> None:
    """Writes a cloud with text rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS {len(points)}\nDATA ascii\n"
    rows = "\n".join(" ".join(f"{number:.3f}" for number in row) for row in points)
    path.write_text(head + rows + "\n")


def _car(x: float, y: float, yaw: float, rng: np.random.Generator) -> Floats:
    """Returns points on the sides and the roof of a box."""
    length_m, width_m, height_m = CAR_M
    at = rng.uniform(-0.5, 0.5, (1500, 3)) * CAR_M
    side = rng.integers(0, 5, 1500)
    at[side == 0, 0], at[side == 1, 0] = length_m / 2, -length_m / 2
    at[side == 2, 1], at[side == 3, 1] = width_m / 2, -width_m / 2
    at[:, 2] += height_m / 2
    at[side == 4, 2] = height_m
    return SE3.from_pose([x, y, 0, 0, 0, yaw]).apply(at)
