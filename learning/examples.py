"""Windows to learn from, drawn from moments: turned, mirrored, thinned, with the road or all of it.

Which window is drawn at a step follows from the seed and the step alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from learning.moments import Moment
from learning.targets import Targets, targets_of
from perception.arrays import Bools, Floats, Floats32, Ints
from perception.pillars.config import PillarsConfig
from perception.pillars.voxels import Pillars, Window, pillars_of
from perception.roadway import Roadway
from protocol.roadmap import RoadMap

SURE_POINTS = 3  # fewer on a vehicle tell too little to ask for it
WIDE_M = 60.0  # how far beyond the lanes the road's height is known
FENCE_M = 0.5
_BELOW_M, _ABOVE_M = 2.0, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A moment made ready, by shot: points (N, 3), map frame, on the road and around it.

    `height_m` (N,) is over the road. The boxes (M, 7) have z over the road; `points_on` (S, M).
    """

    points: list[Floats32]
    height_m: list[Floats32]
    on_road: list[Bools]
    boxes: Floats
    points_on: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """A window and what should be said of it."""

    pillars: Pillars
    targets: Targets


class Roads:
    """The rasters of one network, for moments on it."""

    def __init__(self, road_map: RoadMap) -> None:
        self._wide = Roadway.of(road_map, margin_m=WIDE_M)
        self._fence = Roadway.of(road_map, margin_m=FENCE_M)

    def sight(self, moment: Moment) -> Sight:
        """Places a moment's shots on the road."""
        placed = [
            self._wide.place(shot.points, shot.map_SE3_sensor, below_m=_BELOW_M, above_m=_ABOVE_M)
            for shot in moment.shots
        ]
        boxes = moment.boxes.copy()
        boxes[:, 2] -= self._wide.height_at(boxes)
        return Sight(
            [part.points for part in placed],
            [part.points[:, 2] - part.road_m for part in placed],
            [self._fence.contains(part.points) for part in placed],
            boxes,
            moment.points_on,
        )


def example_of(
    sight: Sight, cells: int, config: PillarsConfig, rng: np.random.Generator
) -> Example:
    """Draws a window of so many cells from a moment."""
    shots = _some_shots(len(sight.points), rng)
    fenced = rng.random() < 0.6
    points = np.concatenate([sight.points[s] for s in shots])
    height_m = np.concatenate([sight.height_m[s] for s in shots])
    keep = np.ones(len(points), np.bool_)
    if fenced:
        keep &= np.concatenate([sight.on_road[s] for s in shots])
    if rng.random() < 0.2:
        keep &= height_m > rng.uniform(0.1, 0.35)  # as senders do that take the ground away
    if rng.random() < 0.3:
        keep &= rng.random(len(points)) < rng.uniform(0.3, 1.0)
    seen = sight.points_on[shots].sum(axis=0)
    middle = _middle(points, sight.boxes[seen >= SURE_POINTS], rng)
    half_m = cells * config.cell_m / 2
    keep &= (np.abs(points[:, :2] - middle) < half_m * np.sqrt(2)).all(axis=1)
    window = Window(np.array([-half_m, -half_m]), cells)
    turn = _Turn(rng)
    there = turn.points(points[keep] - np.array([*middle, 0], np.float32))
    lift = np.float32(rng.normal(0, 0.05))
    pillars = pillars_of(there, height_m[keep] * np.float32(turn.scale) + lift, window, config)
    boxes = turn.boxes(sight.boxes - np.array([*middle, 0, 0, 0, 0, 0]))
    boxes[:, 2] += lift
    inside = (np.abs(boxes[:, :2]) < half_m).all(axis=1) & (seen > 0)
    targets = targets_of(boxes[inside], seen[inside] >= SURE_POINTS, window, config)
    return Example(pillars, targets)


class _Turn:
    """A turn about the vertical, perhaps a mirror, and a little stretching."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.angle_rad = rng.uniform(0, 2 * np.pi)
        self.mirror = 1.0 if rng.random() < 0.5 else -1.0
        self.scale = rng.uniform(0.95, 1.05)
        cos, sin = np.cos(self.angle_rad), np.sin(self.angle_rad)
        self._matrix = self.scale * np.array([[cos, -sin], [sin, cos]]) @ np.diag([1, self.mirror])

    def points(self, points: Floats32) -> Floats32:
        moved = np.empty_like(points)
        moved[:, :2] = points[:, :2] @ self._matrix.T.astype(np.float32)
        moved[:, 2] = points[:, 2]
        return moved

    def boxes(self, boxes: Floats) -> Floats:
        moved = boxes.copy()
        moved[:, :2] = boxes[:, :2] @ self._matrix.T
        moved[:, 2:6] *= self.scale
        moved[:, 6] = self.mirror * boxes[:, 6] + self.angle_rad
        return moved


def _some_shots(count: int, rng: np.random.Generator) -> list[int]:
    """Returns one shot, or several to be merged, as likely."""
    size = 1 if rng.random() < 0.5 else int(rng.integers(1, count + 1))
    return [int(i) for i in rng.permutation(count)[:size]]


def _middle(points: Floats32, seen: Floats, rng: np.random.Generator) -> Floats:
    """Returns where the window lies: around a vehicle that is seen, else around any point."""
    if len(seen) and rng.random() < 0.85:
        place = seen[rng.integers(len(seen)), :2]
    elif len(points):
        place = points[rng.integers(len(points)), :2].astype(np.float64)
    else:
        place = np.zeros(2)
    return np.asarray(place + rng.uniform(-25, 25, 2))
