"""Training examples: windows drawn from scene samples, and the targets of their anchors.

Windows are turned, mirrored and thinned, with the road alone or all around it. Which window is
drawn at a step follows from the seed and the step alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from learning.dataset import SceneSample
from perception.arrays import Bools, Bytes, Floats, Floats32, Ints, Ints32
from perception.pillars.config import ANCHOR_YAWS, STRIDE, PillarsConfig
from perception.pillars.network import middle_of, terms_of
from perception.pillars.windows import Pillars, Window, pillars_of
from perception.roadway import Roadway
from protocol.roadmap import RoadMap

_OBLIQUE_RAD = np.pi / 3
FAINT_IOU = 0.1  # of a vehicle with too few points to be required
NO_OWNER = -1


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """By anchor, kinds first: `owner` (A,) is -1 for none; `counts` (A,) if it is judged.

    `place` (V,) are the anchors that are vehicles, and `terms` (V, 7) theirs.
    """

    is_vehicle: Bools
    counts: Bools
    place: Ints32
    terms: Floats32


def targets_of(
    boxes: Floats, classes: Bytes, sure: Bools, window: Window, config: PillarsConfig
) -> Targets:
    """Assigns anchors to boxes (N, 7) of their class, z over the road.

    Those not `sure` (N,) are not judged.
    """
    rows, columns = (side // STRIDE for side in window.size)
    places = rows * columns
    overlap = np.zeros(config.kinds * places, np.float32)
    owner = np.full(len(overlap), NO_OWNER, np.int32)
    step_m = STRIDE * config.cell_m
    for number, anchor in enumerate(config.anchors):
        own = slice(number * ANCHOR_YAWS * places, (number + 1) * ANCHOR_YAWS * places)
        grid = np.array([*window.low, step_m, *anchor.size_m[:2]], np.float64)
        members = np.flatnonzero(classes == anchor.object_class)
        if len(members):
            chosen = np.ascontiguousarray(boxes[members], np.float64)
            _assign(chosen, grid, rows, columns, overlap[own], owner[own])
            owner[own] = np.where(owner[own] >= 0, members[owner[own]], NO_OWNER)
    by_anchor = ANCHOR_YAWS * places
    object_iou = np.repeat([one.object_iou for one in config.anchors], by_anchor)
    nothing_iou = np.repeat([one.nothing_iou for one in config.anchors], by_anchor)
    sure_owner = (owner >= 0) & np.append(sure, False)[owner]
    is_vehicle = sure_owner & (overlap >= object_iou)
    _claim_best(overlap, owner, len(boxes), is_vehicle, sure)
    faint = (owner >= 0) & ~sure_owner & (overlap >= FAINT_IOU)
    counts = is_vehicle | ~((overlap >= nothing_iou) | faint)
    place = np.flatnonzero(is_vehicle).astype(np.int32)
    kind, cell = np.divmod(place, places)
    middle = middle_of(cell, window, config)
    terms = terms_of(boxes[owner[place]], middle, kind, config)
    return Targets(is_vehicle, counts, place, terms)


@njit(
    "void(float64[:,::1], float64[::1], int64, int64, float32[::1], int32[::1])",
    cache=True,
    nogil=True,
)
def _assign(
    boxes: Floats, grid: Floats, rows: int, columns: int, overlap: Floats32, owner: Ints32
) -> None:
    """Gives each anchor the box it overlaps most, turned to lie along the box or across it.

    An anchor within `_OBLIQUE_RAD` of a box's yaw lies along it. A box between both anchors' yaws
    has both, so that the choice between them is not arbitrary.
    """
    low_x, low_y, step_m, length_m, width_m = grid
    for index in range(boxes.shape[0]):
        x, y, long_m, wide_m = boxes[index, 0], boxes[index, 1], boxes[index, 3], boxes[index, 4]
        cos, sin = np.cos(boxes[index, 6]), np.sin(boxes[index, 6])
        reach_m = (np.hypot(long_m, wide_m) + np.hypot(length_m, width_m)) / 2
        first_row = max(int((y - reach_m - low_y) / step_m), 0)
        last_row = min(int((y + reach_m - low_y) / step_m), rows - 1)
        first_column = max(int((x - reach_m - low_x) / step_m), 0)
        last_column = min(int((x + reach_m - low_x) / step_m), columns - 1)
        for row in range(first_row, last_row + 1):
            off_y = low_y + (row + 0.5) * step_m - y
            for column in range(first_column, last_column + 1):
                off_x = low_x + (column + 0.5) * step_m - x
                off_along, off_across = (
                    abs(cos * off_x + sin * off_y),
                    abs(cos * off_y - sin * off_x),
                )
                for kind in range(2):
                    lies_along = abs(cos if kind == 0 else sin) > np.cos(_OBLIQUE_RAD)
                    along = length_m if lies_along else width_m
                    across = width_m if lies_along else length_m
                    common_along = min(min(long_m, along), (long_m + along) / 2 - off_along)
                    common_across = min(min(wide_m, across), (wide_m + across) / 2 - off_across)
                    if common_along <= 0 or common_across <= 0:
                        continue
                    area = common_along * common_across
                    iou = area / (long_m * wide_m + length_m * width_m - area)
                    place = (kind * rows + row) * columns + column
                    if iou > overlap[place]:
                        overlap[place] = iou
                        owner[place] = index


@njit("void(float32[::1], int32[::1], int64, boolean[::1], boolean[::1])", cache=True, nogil=True)
def _claim_best(
    overlap: Floats32, owner: Ints32, boxes: int, is_vehicle: Bools, sure: Bools
) -> None:
    """Makes each sure box's best anchor a vehicle, so that none is without."""
    best = np.full(boxes, -1, np.int64)
    for place in range(owner.size):
        index = owner[place]
        if (
            index >= 0
            and sure[index]
            and (best[index] < 0 or overlap[place] > overlap[best[index]])
        ):
            best[index] = place
    for index in range(boxes):
        if best[index] >= 0:
            is_vehicle[best[index]] = True


SURE_POINTS = 3  # with fewer, a vehicle is not required
WIDE_M = 60.0  # how far beyond the lanes the road's height is known
FENCE_M = 0.5
OFF_M = 25.0  # a window's middle from the point it was chosen for
LIFT_STD_M = 0.1  # the height of an open ground is not known better
BELOW_M, ABOVE_M = 2.0, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class PlacedSample:
    """A sample made ready, by scan: points (N, 3), map frame, on the road and around it.

    `height_m` (N,) is over the road. The boxes (M, 7) have z over the road; `classes` (M,) are of
    `ObjectClass`; `points_on` (S, M).
    """

    points: list[Floats32]
    height_m: list[Floats32]
    on_road: list[Bools]
    boxes: Floats
    classes: Bytes
    points_on: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """A window and its targets."""

    pillars: Pillars
    targets: Targets


class RoadRasters:
    """The rasters of one network, for samples on it."""

    def __init__(self, road_map: RoadMap) -> None:
        self._wide = Roadway.of(road_map, margin_m=WIDE_M)
        self._fence = Roadway.of(road_map, margin_m=FENCE_M)

    def placed(self, sample: SceneSample) -> PlacedSample:
        """Places a sample's scans on the road."""
        placed = [
            self._wide.place(scan.points, scan.map_SE3_sensor, below_m=BELOW_M, above_m=ABOVE_M)
            for scan in sample.scans
        ]
        boxes = sample.boxes.copy()
        boxes[:, 2] -= self._wide.height_at(boxes)
        return PlacedSample(
            [part.points for part in placed],
            [part.points[:, 2] - part.road_m for part in placed],
            [self._fence.contains(part.points) for part in placed],
            boxes,
            sample.classes,
            sample.points_on,
        )


def example_of(
    sample: PlacedSample, cells: int, config: PillarsConfig, rng: np.random.Generator
) -> Example:
    """Draws a window of so many cells from a sample."""
    scans = _some_scans(len(sample.points), rng)
    seen = sample.points_on[scans].sum(axis=0)
    middle = _middle(sample, scans, sample.boxes[seen >= SURE_POINTS], rng)
    half_m = cells * config.cell_m / 2
    thinning, turn = _Thinning.draw(rng), _Turn(rng)
    points, height_m = _gather(sample, scans, thinning, turn, middle, half_m * np.sqrt(2))
    lift_m = rng.normal(0, LIFT_STD_M)
    window = Window(np.array([-half_m, -half_m]), cells, cells)
    pillars = pillars_of(points, height_m + np.float32(lift_m), window, config)
    boxes = turn.boxes(sample.boxes - np.array([*middle, 0, 0, 0, 0, 0]))
    boxes[:, 2] += lift_m
    inside = (np.abs(boxes[:, :2]) < half_m).all(axis=1) & (seen > 0)
    sure = seen[inside] >= SURE_POINTS
    targets = targets_of(boxes[inside], sample.classes[inside], sure, window, config)
    return Example(pillars, targets)


@dataclass(frozen=True, slots=True)
class _Thinning:
    """Augmentation that removes points: off the road, near the ground (as senders), at random."""

    fenced: bool
    least_m: float
    share: float
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> _Thinning:
        return cls(
            bool(rng.random() < 0.45),
            rng.uniform(0.1, 0.35) if rng.random() < 0.2 else -np.inf,
            rng.uniform(0.3, 1.0) if rng.random() < 0.3 else 1.0,
            int(rng.integers(1 << 62)),
        )


class _Turn:
    """Augmentation by rotation about the vertical, perhaps mirroring, and a little scaling."""

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


def _some_scans(count: int, rng: np.random.Generator) -> list[int]:
    """Returns one scan, or several to be merged, as likely."""
    size = 1 if rng.random() < 0.5 else int(rng.integers(1, count + 1))
    return [int(i) for i in rng.permutation(count)[:size]]


def _middle(
    sample: PlacedSample, scans: list[int], seen: Floats, rng: np.random.Generator
) -> Floats:
    """Returns the window's centre: near a vehicle that is seen, else near any point."""
    points = sample.points[scans[0]]
    place = np.zeros(2)
    if len(seen) and rng.random() < 0.85:
        place = seen[rng.integers(len(seen)), :2]
    elif len(points):
        place = points[rng.integers(len(points)), :2].astype(np.float64)
    return np.asarray(place + rng.uniform(-OFF_M, OFF_M, 2))


def _gather(
    sample: PlacedSample,
    scans: list[int],
    thinning: _Thinning,
    turn: _Turn,
    middle: Floats,
    reach_m: float,
) -> tuple[Floats32, Floats32]:
    """Returns the points (N, 3) kept near the middle, turned about it, and heights (N,)."""
    room = sum(len(sample.points[scan]) for scan in scans)
    points, height_m = np.empty((room, 3), np.float32), np.empty(room, np.float32)
    frame = np.array([*middle, reach_m, *turn.matrix.reshape(-1), turn.scale])
    rule = np.array([thinning.fenced, thinning.least_m, thinning.share])
    count = 0
    for scan in scans:
        part = (sample.points[scan], sample.height_m[scan], sample.on_road[scan])
        seed = thinning.seed + scan
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
