"""False positive filter: boxes are no vehicle if points lie behind, over or beyond, or hardly in.

A detector that has only seen simulated streets takes rows of trees, walls and roofs on posts for
lorries. But a vehicle is opaque and ends at its roof, its bumper and its rear. Here points are
counted, box by box, that speak against it: those that a sensor saw right through the box, those
deep in it that a sensor saw through its near side, as the back of a bus shelter or of a room, those
that stand in a column over it, as a wall does (a tree's crown over a car leaves air between), and
the metres that its upper part goes on beyond its ends, as a hedge does. Cars that stand bumper to
bumper have metres of air between their cabins. For leaves see `perception.roughness`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bools, Bytes, Floats, Floats32, Ints
from perception.detector import Cloud, Vehicles
from perception.roadway import Roadway, merge
from perception.roughness import LOW_M, OWN_M, are_leafy
from protocol.messages import ObjectClass

AIR_M = (0.3, 1.3)  # over a roof, which a wall fills and a crown leaves free
HIGHER_M = 0.8  # over a roof, from where on nothing can be the vehicle's
CORE = 0.6  # of a box's length and width: rays through it go through the vehicle
WINDOWS = 0.7  # of the height, from where on a vehicle may be looked through
EYE_M = 1.5  # of a sensor over the road, at least: poses may be those of a wheel's axle
BINS = 720  # of directions around a sensor
LEAST = 5  # fewer points show nothing
DEEP_M = 1.3  # behind the side of a box that a ray meets: no body of a vehicle is seen there
MOST_DEEP = 0.5  # of a box's points between LOW_M and its windows
_COUNTS = 7
# Points against a box as a share of its own: seen through, in the air over it, higher. Lorries
# are long and closed, and walls taken for them hardly reach over the band of heights that is kept.
MOST = {ObjectClass.CAR: (0.5, 0.3, 0.3), ObjectClass.TRUCK: (0.3, 0.01, 0.01)}
MOST_BEYOND_M = {ObjectClass.CAR: (2.5, np.inf), ObjectClass.TRUCK: (np.inf, 1.0)}
"""How far what is boxed may go on beyond one end, and beyond both: boxes of lorries are too short
where a part alone is seen."""
UPPER = 0.7  # of a box's height, over a car's bonnet: where points tell whether it goes on
STEP_M, GAP_STEPS = 0.25, 2  # along a box: so many empty steps end what goes on
BEYOND_M = 3.0  # beyond an end: so far is looked
INSIDE_STEPS = 2  # of a box's end: from there on it is followed
BESIDE_M = 0.3  # of a box: points of what goes on
SLENDER = (np.inf, np.inf, np.inf)  # what may be looked past
LEAST_OWN, LEAST_SEEN = 5, 0.075
"""Points of a box, and the share of a sensor's rays towards it that reached it. Fewer are what one
sees of a room through a window, or of a wall past a lorry. Of some cars behind others less is seen,
so that it is asked for only where there is no road map."""


def solid_of(
    found: Vehicles,
    cloud: Cloud,
    roadway: Roadway,
    *,
    unmapped: bool = False,
    lower_m: float = 0.0,
) -> Vehicles:
    """Returns those vehicles of a cloud, map frame, whose boxes may be vehicles.

    Boxes are taken to stand on the ground, `lower_m` below the road. Where roads are `unmapped`, so
    that hedges and houses stand on what is taken for them, those hardly seen, open ones and leaves
    are left out too.
    """
    parts = [*cloud.near, *cloud.bare]
    points, road_m = merge(parts)
    boxes, sensors = found.boxes.copy(), cloud.sensors.astype(np.float64)
    boxes[:, 2] = boxes[:, 5] / 2
    sensors[:, 2] -= roadway.height_at(sensors) - lower_m
    sizes = np.array([len(part.points) for part in parts], np.int64)
    over_road_m = points[:, 2] - road_m
    height_m = over_road_m + np.float32(lower_m)
    observed = observations_of(boxes, points, height_m, sizes, sensors)
    kept = are_solid(found.classes, observed)
    if unmapped:
        kept &= are_seen(observed) & ~are_open(found.classes, observed)
        asked = np.flatnonzero(kept & (found.classes <= ObjectClass.TRUCK))
        for given_m in (
            (height_m, over_road_m) if lower_m else (height_m,)
        ):  # a hedge is one on both
            kept[asked] &= ~are_leafy(boxes[asked], points, given_m, sizes)
    return found.take(kept)


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """What was seen at boxes (N,).

    Attributes:
        counts: points in it, seen through it, in the air over it, and higher (N, 4).
        beyond_m: how far what is boxed goes on beyond its rear and its front (N, 2).
        seen: the share of the rays towards it that ended in it, of the sensor that sees most (N,).
        deep: points in it below its windows, and those of them deep behind its near side (N, 2).
    """

    counts: Ints
    beyond_m: Floats
    seen: Floats
    deep: Ints


def are_seen(observed: Observations) -> Bools:
    """Marks the boxes (N,) of which enough was seen."""
    enough = observed.counts[:, 0] >= LEAST_OWN
    return np.asarray(enough & (observed.seen >= LEAST_SEEN))


def are_open(classes: Bytes, observed: Observations) -> Bools:
    """Marks the boxes (N,) of cars and lorries that rays go deep into."""
    below, deep = observed.deep.T
    is_deep = (deep >= LEAST) & (deep >= MOST_DEEP * below)
    return np.asarray(is_deep & (classes <= ObjectClass.TRUCK))


def are_solid(classes: Bytes, observed: Observations) -> Bools:
    """Marks the boxes (N,) of classes of `ObjectClass` (N,) that may be vehicles."""
    counts, beyond_m = observed.counts, observed.beyond_m
    most_m = [MOST_BEYOND_M.get(ObjectClass(kind), SLENDER[:2]) for kind in classes]
    one_m, both_m = np.array(most_m).reshape(-1, 2).T
    goes_on = (beyond_m.max(axis=1) >= one_m) | (beyond_m.min(axis=1) >= both_m)
    most = np.array([MOST.get(ObjectClass(kind), SLENDER) for kind in classes]).reshape(-1, 3)
    speaks = (counts[:, 1:] >= LEAST) & (counts[:, 1:] > most * np.maximum(counts[:, :1], 1))
    return np.asarray(~(speaks[:, 0] | (speaks[:, 1] & speaks[:, 2]) | goes_on))


def observations_of(
    boxes: Floats, points: Floats32, height_m: Floats32, sizes: Ints, sensors: Floats
) -> Observations:
    """Returns what was seen at boxes.

    Args:
        boxes: x, y, z over the road, length, width, height, yaw (N, 7).
        points: map frame (P, 3), part by part.
        height_m: of the points over the road (P,).
        sizes: how many points each part has (K,).
        sensors: the place that each part was seen from, z over the road (K, 3).
    """
    counts, seen = np.zeros((len(boxes), _COUNTS), np.int64), np.zeros(len(boxes))
    steps = int((boxes[:, 3].max(initial=0.0) + 2 * BEYOND_M) / STEP_M) + 1
    is_upper = np.zeros((len(boxes), steps), np.bool_)
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    for part, sensor in enumerate(np.asarray(sensors, np.float64)):
        own = slice(starts[part], starts[part + 1])
        if starts[part + 1] > starts[part] and len(boxes):
            eye = np.array([sensor[0], sensor[1], max(sensor[2], EYE_M)])
            seen_by = np.zeros_like(counts)
            given = np.ascontiguousarray(boxes), points[own], height_m[own], eye
            _count(*given, seen_by, is_upper)
            rays = seen_by[:, 0] + seen_by[:, 4]
            seen = np.maximum(seen, seen_by[:, 0] / np.maximum(rays, 1))
            counts += seen_by
    beyond_m = _beyond_m(is_upper, np.ascontiguousarray(boxes[:, 3]))
    return Observations(counts[:, :4], beyond_m, seen, counts[:, 5:])


@njit("float64[:,::1](boolean[:,::1], float64[::1])", cache=True, nogil=True)
def _beyond_m(is_upper: Bools, lengths_m: Floats) -> Floats:
    """Follows the steps along each box (N, S) that hold points from inside both ends outwards."""
    result = np.zeros((lengths_m.size, 2))
    steps = is_upper.shape[1]
    for box in range(lengths_m.size):
        ends = int(BEYOND_M / STEP_M), int((BEYOND_M + lengths_m[box]) / STEP_M)
        for side in range(2):
            way = 2 * side - 1
            at, last, empty = ends[side] - way * INSIDE_STEPS, ends[side], 0
            while 0 <= at < steps and empty <= GAP_STEPS:
                empty = 0 if is_upper[box, at] else empty + 1
                last = at if is_upper[box, at] else last
                at += way
            result[box, side] = max(way * (last - ends[side]), 0) * STEP_M
    return result


@njit("int64(float64, float64)", cache=True, nogil=True, inline="always")
def _bin(x: float, y: float) -> int:
    return int((np.arctan2(y, x) + np.pi) / (2 * np.pi) * BINS) % BINS


@njit("Tuple((int64[::1], int64[::1]))(float32[:,::1], float64[::1])", cache=True, nogil=True)
def _by_direction(points: Floats32, eye: Floats) -> tuple[Ints, Ints]:
    """Returns the points' indices by direction (P,), and where each direction's begin."""
    count = points.shape[0]
    bin_of, starts = np.empty(count, np.int32), np.zeros(BINS + 1, np.int64)
    for index in range(count):
        bin_of[index] = _bin(points[index, 0] - eye[0], points[index, 1] - eye[1])
        starts[bin_of[index] + 1] += 1
    starts = np.cumsum(starts)
    following, order = starts.copy(), np.empty(count, np.int64)
    for index in range(count):
        order[following[bin_of[index]]] = index
        following[bin_of[index]] += 1
    return order, starts


@njit(
    "UniTuple(float64, 2)(UniTuple(float64, 3), UniTuple(float64, 3), UniTuple(float64, 3))",
    cache=True,
    nogil=True,
)
def _crossing(
    eye: tuple[float, float, float],
    point: tuple[float, float, float],
    half: tuple[float, float, float],
) -> tuple[float, float]:
    """Returns where the ray from eye to point enters a rectangle and leaves it: 1 is at the point.

    All are (3,) along a box, across it and over the road, from its middle; of `half` the height
    does not matter. If it misses the rectangle, it leaves it before it enters it.
    """
    enter, leave = -np.inf, np.inf
    for axis in range(2):
        step = point[axis] - eye[axis]
        if abs(step) < 1e-9:
            if abs(eye[axis]) > half[axis]:
                return 1.0, 0.0
            continue
        one, other = (-half[axis] - eye[axis]) / step, (half[axis] - eye[axis]) / step
        enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
    return enter, leave


@njit(
    "boolean(UniTuple(float64, 3), UniTuple(float64, 3), UniTuple(float64, 3))",
    cache=True,
    nogil=True,
)
def _is_through(
    eye: tuple[float, float, float],
    point: tuple[float, float, float],
    core: tuple[float, float, float],
) -> bool:
    """Whether the ray from eye to point goes through a core, all below its top and over the ground.

    See `_crossing`.
    """
    enter, leave = _crossing(eye, point, core)
    if enter >= leave or leave >= 1.0 or enter <= 0.0:
        return False
    rise = point[2] - eye[2]
    first, last = eye[2] + enter * rise, eye[2] + leave * rise
    return bool(min(first, last) > LOW_M and max(first, last) < core[2])


@njit(
    "boolean(UniTuple(float64, 3), UniTuple(float64, 3), UniTuple(float64, 3))",
    cache=True,
    nogil=True,
)
def _is_towards(
    eye: tuple[float, float, float],
    point: tuple[float, float, float],
    box: tuple[float, float, float],
) -> bool:
    """Whether a ray leads to the side of a box that faces it, however far it came; see `_crossing`.

    The box's third number is its whole height.
    """
    enter, leave = _crossing(eye, point, box)
    if enter >= leave or enter <= 0.0:
        return False
    return bool(LOW_M < eye[2] + enter * (point[2] - eye[2]) < box[2])


@njit(
    "boolean(UniTuple(float64, 3), UniTuple(float64, 3), UniTuple(float64, 3))",
    cache=True,
    nogil=True,
)
def _is_deep(
    eye: tuple[float, float, float],
    point: tuple[float, float, float],
    box: tuple[float, float, float],
) -> bool:
    """Whether a point in a box lies far behind the side that its ray met; see `_crossing`."""
    enter, leave = _crossing(eye, point, box)
    if enter >= leave or enter <= 0.0:
        return False
    return bool((1.0 - enter) * np.hypot(point[0] - eye[0], point[1] - eye[1]) > DEEP_M)


@njit(
    "void(float64[:,::1], float32[:,::1], float32[::1], float64[::1], int64[:,::1], "
    "boolean[:,::1])",
    cache=True,
    nogil=True,
)
def _count(
    boxes: Floats,
    points: Floats32,
    height_m: Floats32,
    eye: Floats,
    result: Ints,
    is_upper: Bools,
) -> None:
    """Counts what one sensor saw: points, rays to each box that ended elsewhere, points for `deep`.

    Marks the steps along each box where its upper part was hit.
    """
    order, starts = _by_direction(points, eye)
    for box in range(boxes.shape[0]):
        length, width = boxes[box, 3], boxes[box, 4]
        top_m = boxes[box, 2] + boxes[box, 5] / 2
        cos, sin = np.cos(boxes[box, 6]), np.sin(boxes[box, 6])
        off_x, off_y = boxes[box, 0] - eye[0], boxes[box, 1] - eye[1]
        reach_m, away_m = (
            np.hypot(length / 2 + BEYOND_M, width / 2 + BESIDE_M),
            np.hypot(off_x, off_y),
        )
        first, wide = 0, BINS
        if away_m > reach_m:
            half = int(np.arcsin(reach_m / away_m) / (2 * np.pi) * BINS) + 1
            first, wide = _bin(off_x, off_y) - half, min(2 * half + 1, BINS)
        seen_from = (-cos * off_x - sin * off_y, sin * off_x - cos * off_y, eye[2])
        sides = (length / 2, width / 2, top_m)
        for step in range(wide):
            at = (first + step) % BINS
            for slot in range(starts[at], starts[at + 1]):
                index = order[slot]
                high_m = height_m[index]
                x, y = points[index, 0] - boxes[box, 0], points[index, 1] - boxes[box, 1]
                u, v = cos * x + sin * y, cos * y - sin * x
                at_m = (u, v, high_m)
                if UPPER * top_m < high_m <= top_m + OWN_M and abs(v) <= width / 2 + BESIDE_M:
                    along = (u + length / 2 + BEYOND_M) / STEP_M
                    if 0 <= along < is_upper.shape[1]:
                        is_upper[box, int(along)] = True
                if abs(u) <= length / 2 + OWN_M and abs(v) <= width / 2 + OWN_M:
                    over_m = high_m - top_m
                    result[box, 0] += high_m > LOW_M and over_m <= OWN_M
                    result[box, 2] += AIR_M[0] < over_m <= AIR_M[1]
                    result[box, 3] += over_m > HIGHER_M
                    if LOW_M < high_m < WINDOWS * top_m:
                        result[box, 5] += 1
                        result[box, 6] += _is_deep(seen_from, at_m, sides)
                    continue
                core = (CORE / 2 * length, CORE / 2 * width, WINDOWS * top_m)
                result[box, 1] += _is_through(seen_from, at_m, core)
                result[box, 4] += _is_towards(seen_from, at_m, sides)
