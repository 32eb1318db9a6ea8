"""Windows to learn from, drawn from moments: turned, mirrored, thinned, with the road or all of it.

Which window is drawn at a step follows from the seed and the step alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from learning.moments import Moment
from learning.targets import Targets, targets_of
from perception.arrays import Bools, Floats, Floats32, Ints
from perception.pillars.config import PillarsConfig
from perception.pillars.windows import Pillars, Window, pillars_of
from perception.roadway import Roadway
from protocol.roadmap import RoadMap

SURE_POINTS = 3  # fewer on a vehicle tell too little to ask for it
WIDE_M = 60.0  # how far beyond the lanes the road's height is known
FENCE_M = 0.5
OFF_M = 25.0  # a window's middle from what it was chosen for
LIFT_STD_M = 0.05  # the road's height is not known better
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
    seen = sight.points_on[shots].sum(axis=0)
    middle = _middle(sight, shots, sight.boxes[seen >= SURE_POINTS], rng)
    half_m = cells * config.cell_m / 2
    thinning, turn = _Thinning.draw(rng), _Turn(rng)
    points, height_m = _gather(sight, shots, thinning, turn, middle, half_m * np.sqrt(2))
    lift_m = rng.normal(0, LIFT_STD_M)
    window = Window(np.array([-half_m, -half_m]), cells, cells)
    pillars = pillars_of(points, height_m + np.float32(lift_m), window, config)
    boxes = turn.boxes(sight.boxes - np.array([*middle, 0, 0, 0, 0, 0]))
    boxes[:, 2] += lift_m
    inside = (np.abs(boxes[:, :2]) < half_m).all(axis=1) & (seen > 0)
    targets = targets_of(boxes[inside], seen[inside] >= SURE_POINTS, window, config)
    return Example(pillars, targets)


@dataclass(frozen=True, slots=True)
class _Thinning:
    """Which points are left out: off the road, near the ground (as senders do), or at random."""

    fenced: bool
    least_m: float
    share: float
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> _Thinning:
        return cls(
            bool(rng.random() < 0.6),
            rng.uniform(0.1, 0.35) if rng.random() < 0.2 else -np.inf,
            rng.uniform(0.3, 1.0) if rng.random() < 0.3 else 1.0,
            int(rng.integers(1 << 62)),
        )


class _Turn:
    """A turn about the vertical, perhaps a mirror, and a little stretching."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.angle_rad = rng.uniform(0, 2 * np.pi)
        self.mirror = 1.0 if rng.random() < 0.5 else -1.0
        self.scale = rng.uniform(0.95, 1.05)
        cos, sin = np.cos(self.angle_rad), np.sin(self.angle_rad)
        self.matrix = self.scale * np.array([[cos, -sin], [sin, cos]]) @ np.diag([1, self.mirror])

    def boxes(self, boxes: Floats) -> Floats:
        moved = boxes.copy()
        moved[:, :2] = boxes[:, :2] @ self.matrix.T
        moved[:, 2:6] *= self.scale
        moved[:, 6] = self.mirror * boxes[:, 6] + self.angle_rad
        return moved


def _some_shots(count: int, rng: np.random.Generator) -> list[int]:
    """Returns one shot, or several to be merged, as likely."""
    size = 1 if rng.random() < 0.5 else int(rng.integers(1, count + 1))
    return [int(i) for i in rng.permutation(count)[:size]]


def _middle(sight: Sight, shots: list[int], seen: Floats, rng: np.random.Generator) -> Floats:
    """Returns where the window lies: around a vehicle that is seen, else around any point."""
    points = sight.points[shots[0]]
    place = np.zeros(2)
    if len(seen) and rng.random() < 0.85:
        place = seen[rng.integers(len(seen)), :2]
    elif len(points):
        place = points[rng.integers(len(points)), :2].astype(np.float64)
    return np.asarray(place + rng.uniform(-OFF_M, OFF_M, 2))


def _gather(
    sight: Sight,
    shots: list[int],
    thinning: _Thinning,
    turn: _Turn,
    middle: Floats,
    reach_m: float,
) -> tuple[Floats32, Floats32]:
    """Returns what is left near the middle, turned about it: points (N, 3) and heights (N,)."""
    room = sum(len(sight.points[shot]) for shot in shots)
    points, height_m = np.empty((room, 3), np.float32), np.empty(room, np.float32)
    frame = np.array([*middle, reach_m, *turn.matrix.reshape(-1), turn.scale])
    rule = np.array([thinning.fenced, thinning.least_m, thinning.share])
    count = 0
    for shot in shots:
        part = (sight.points[shot], sight.height_m[shot], sight.on_road[shot])
        seed = thinning.seed + shot
        count += _take(*part, frame, rule, seed, points[count:], height_m[count:])
    return points[:count], height_m[:count]


@njit(
    "int64(float32[:,::1], float32[::1], boolean[::1], float64[::1], float64[::1], int64, "
    "float32[:,::1], float32[::1])",
    cache=True,
    nogil=True,
)
def _take(
    points: Floats32,
    height_m: Floats32,
    on_road: Bools,
    frame: Floats,
    rule: Floats,
    seed: int,
    out: Floats32,
    out_m: Floats32,
) -> int:
    x0, y0, reach_m, a, b, c, d, scale = frame
    fenced, least_m, share = rule[0] > 0, rule[1], rule[2]
    state, count = np.uint64(seed), 0
    for index in range(points.shape[0]):
        x, y = points[index, 0] - x0, points[index, 1] - y0
        if abs(x) > reach_m or abs(y) > reach_m:
            continue
        if (fenced and not on_road[index]) or height_m[index] <= least_m:
            continue
        if share < 1:
            # a linear congruence's upper bits are random enough to thin by
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            if np.float64(state >> np.uint64(11)) / 9007199254740992.0 > share:
                continue
        out[count, 0], out[count, 1] = a * x + b * y, c * x + d * y
        out[count, 2] = points[index, 2]
        out_m[count] = height_m[index] * scale
        count += 1
    return count
