"""Oriented bounding boxes: one per cluster, completed to the usual size of its class; IoU, NMS.

The direction is searched by the closeness criterion of Zhang et al. 2017 ("Efficient L-shape
fitting for vehicle detection using laser scanners"), with the road's direction as a prior; where
too few points determine a direction, the road's is taken.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Floats32, Ints
from perception.clusters import Clusters
from perception.completion import Fitted, complete, lowest_at_ends
from perception.detector import Vehicles
from perception.object_classes import (
    PERSON_TOP_M,
    TALL_M,
    WIDEST_VEHICLE_M,
    Shapes,
    classes_of,
    usual_m,
)
from perception.parallel import each, threads
from perception.roadway import Roadway

FIT_POINTS = 160  # of a cluster at most: more do not change the direction
FEW_POINTS = 12  # fewer determine none
STEPS = 15  # of 3 degrees, to either side
PRIOR = 0.35  # how much less a direction counts that is 45 degrees off the road's
EDGE_M = 0.08  # points this close to an edge lie on it
WIDE_M = 2.6  # no car is wider: its length and width are taken for each other
LEAST_POINTS, NEAR_M = 8, 50.0  # so near a sensor, fewer are a sliver of what stands elsewhere
LEAST_M, LEAST_HEIGHT_M = 0.5, 0.1  # what is smaller is no vehicle
PERSON_M = 0.2  # but may be a person, if it is so high
LINE_M, LINE_TOP_M = 1.0, 0.4  # of a side that one ring has hit: length, least height over ground
ACROSS_RAD = 1.0  # a box turned farther from the road's direction stands across it
SHARED = 0.2  # of the smaller box: vehicles do not overlap, but boxes of one seen in parts do
CERTAIN_POINTS = 25.0  # about two thirds of full score


def fit_boxes(
    points: Floats32,
    ground_m: Floats32,
    clusters: Clusters,
    *,
    roadway: Roadway,
    sensors: Floats,
    completed: bool = True,
) -> Vehicles:
    """Fits boxes to clusters of points (N, 3), map frame, over ground at the heights (N,).

    A completed box stands on the ground, reaches up to its highest point and has at least the usual
    size of its class; a car's end of which only a window or the roof is seen has a bonnet or a boot
    before it. Else a box holds its points and no more. `sensors` (C, 2) are the places that
    most of each cluster's points were seen from.
    """
    if clusters.count == 0:
        return Vehicles.from_lidar(np.zeros((0, 7)), np.zeros(0))
    members, middles = clusters.means(points)
    starts = np.concatenate([[0], np.cumsum(members)])
    floor_m = _floor_m(ground_m, clusters.runs, members)
    road_yaws = roadway.yaw_at(middles)
    yaws = road_yaws.copy()
    extents = _fit(points, clusters.runs, starts, middles, yaws, floor_m)
    size_m = extents[:, 1] - extents[:, 0]
    shapes = Shapes(
        size_m[:, 0], size_m[:, 1], extents[:, 0, 2] - floor_m, extents[:, 1, 2] - floor_m
    )
    kinds, seen_from_m = shapes.kinds(), _seen_from_m(sensors, middles, yaws)
    kept = (members >= LEAST_POINTS) | (np.linalg.norm(seen_from_m, axis=1) > NEAR_M)
    kept &= shapes.is_vehicle_or_person
    kept &= _stands(shapes, size_m[:, 2]) | _is_line(shapes, size_m[:, 2])
    ends_m = np.full((clusters.count, 2), np.nan)
    if completed:
        over_m = lowest_at_ends(points, clusters.runs, middles, yaws, extents) - floor_m[:, None]
        is_across = np.abs((yaws - road_yaws + np.pi) % (2 * np.pi) - np.pi) > ACROSS_RAD
        ends_m = complete(Fitted(extents, shapes, kinds, members, over_m, seen_from_m, is_across))
        extents[:, 0, 2] = floor_m
        extents[:, 1, 2] = np.maximum(extents[:, 1, 2], floor_m + usual_m(kinds)[:, 2])
    boxes = _boxes(extents, middles, yaws)
    found = Vehicles.from_lidar(boxes, certainty(members), classes_of(kinds))
    found = replace(found, ends_m=ends_m).take(kept)
    return found.take(np.sort(suppress(found.boxes, found.scores, iou=1.0, part=SHARED)))


def main_sensors(clusters: Clusters, sizes: Ints, sensors: Floats) -> Floats:
    """Returns the place (C, 2) that most points of each cluster were seen from.

    Args:
        clusters: of points that come part by part.
        sizes: how many points each part has (P,).
        sensors: the place that each part was seen from (P, 3).
    """
    if clusters.count == 0:
        return np.zeros((0, 2))
    points = _count_by_part(clusters.runs, sizes, clusters.count)
    return np.ascontiguousarray(sensors[points.argmax(axis=1), :2])


@njit("int64[:,::1](int64[:,::1], int64[::1], int64)", cache=True, nogil=True)
def _count_by_part(runs: Ints, sizes: Ints, count: int) -> Ints:
    """Returns how many points of each part are in each of so many clusters (C, P)."""
    points = np.zeros((count, sizes.size), np.int64)
    part, end_of_part = -1, 0
    for run in range(runs.shape[0]):
        label, first, end = runs[run, 0], runs[run, 1], runs[run, 2]
        while first < end:
            while first >= end_of_part:
                part += 1
                end_of_part += sizes[part]
            points[label, part] += min(end, end_of_part) - first
            first = min(end, end_of_part)
    return points


def _seen_from_m(sensors: Floats, middles: Floats, yaws: Floats) -> Floats:
    """Returns the sensors (C, 2) that saw clusters, about their middles (C, 3), turned by yaws."""
    off = sensors - middles[:, :2]
    cos, sin = np.cos(yaws), np.sin(yaws)
    return np.stack([cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0]], -1)


def _stands(shapes: Shapes, height_m: Floats) -> Bools:
    """Marks what is large enough (C,); people are as narrow as they like."""
    long_m = np.maximum(shapes.along_m, shapes.across_m)
    least_m = np.where(shapes.top_m > PERSON_TOP_M, PERSON_M, LEAST_M)
    return np.asarray((long_m >= least_m) & (height_m >= LEAST_HEIGHT_M))


def _is_line(shapes: Shapes, height_m: Floats) -> Bools:
    """Marks what one ring alone has hit, far away, as it would hit a vehicle's side (C,)."""
    line = (height_m < LEAST_HEIGHT_M) & (np.maximum(shapes.along_m, shapes.across_m) >= LINE_M)
    return np.asarray(line & (shapes.top_m >= LINE_TOP_M))


def certainty(members: Ints) -> Floats:
    """Returns the scores (C,) of clusters of so many points."""
    return np.asarray(1.0 - np.exp(-members / CERTAIN_POINTS))


def _boxes(extents: Floats, middles: Floats, yaws: Floats) -> Floats:
    """Returns boxes (C, 7) from extents (C, 2, 3) along their own axes about their middles."""
    along, across, up = ((extents[:, 0] + extents[:, 1]) / 2).T
    cos, sin = np.cos(yaws), np.sin(yaws)
    x = middles[:, 0] + cos * along - sin * across
    y = middles[:, 1] + sin * along + cos * across
    return np.column_stack([x, y, up, extents[:, 1] - extents[:, 0], yaws])


@njit("float64[::1](float32[::1], int64[:,::1], int64[::1])", cache=True, nogil=True)
def _floor_m(ground_m: Floats32, runs: Ints, members: Ints) -> Floats:
    """Returns the mean height of the ground below clusters (C,) of so many points."""
    floor_m = np.zeros(members.size)
    for run in range(runs.shape[0]):
        label, first, end = runs[run, 0], runs[run, 1], runs[run, 2]
        below_m = 0.0
        for index in range(first, end):
            below_m += ground_m[index]
        floor_m[label] += below_m
    return floor_m / members


@njit("void(float64[:,::1], float64, float64[:,::1])", cache=True, nogil=True)
def _measure(local: Floats, yaw: float, extents: Floats) -> None:
    assert local.shape[1] == 2
    cos, sin = np.cos(yaw), np.sin(yaw)
    extents[0, :2], extents[1, :2] = np.inf, -np.inf
    for i in range(local.shape[0]):
        along = cos * local[i, 0] + sin * local[i, 1]
        across = cos * local[i, 1] - sin * local[i, 0]
        extents[0, 0], extents[1, 0] = min(extents[0, 0], along), max(extents[1, 0], along)
        extents[0, 1], extents[1, 1] = min(extents[0, 1], across), max(extents[1, 1], across)


@njit("float64(float32[:,::1], float32[:,::1], float64)", cache=True, nogil=True, fastmath=True)
def _edginess(local: Floats32, turned: Floats32, yaw: float) -> float:
    """Returns how many points (2, N) lie how close to the edges of the box with a yaw.

    `turned` (2, N) is room for the points in the box's frame. In float32, side by side.
    """
    cos, sin = np.float32(np.cos(yaw)), np.float32(np.sin(yaw))
    low_u = low_v = np.float32(np.inf)
    high_u = high_v = np.float32(-np.inf)
    for i in range(local.shape[1]):
        u = cos * local[0, i] + sin * local[1, i]
        v = cos * local[1, i] - sin * local[0, i]
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
        turned[0, i], turned[1, i] = u, v
    edge_m, score = np.float32(EDGE_M), np.float32(0)
    for i in range(local.shape[1]):
        u, v = turned[0, i], turned[1, i]
        off_m = min(min(u - low_u, high_u - u), min(v - low_v, high_v - v))
        score += np.float32(1) / max(off_m, edge_m)
    return np.float64(score)


@njit("float64(float32[:,::1], float64)", cache=True, nogil=True)
def _direction(local: Floats32, road_yaw: float) -> float:
    """Returns the yaw, within 45 degrees of the road's, whose box has most points on its edges."""
    best, best_yaw = -1.0, road_yaw
    turned = np.empty_like(local)
    for turn in range(-STEPS, STEPS + 1):
        yaw = road_yaw + turn * np.pi / 4 / STEPS
        score = _edginess(local, turned, yaw) * (1.0 - PRIOR * abs(turn) / STEPS)
        if score > best:
            best, best_yaw = score, yaw
    return best_yaw


def _fit(
    points: Floats32, runs: Ints, starts: Ints, middles: Floats, yaws: Floats, floor_m: Floats
) -> Floats:
    """Turns each cluster's yaw to the best one; returns extents (C, 2, 3) along the box's axes."""
    local, extents = _about_middles(points, runs, starts, middles)

    def fit(first: int) -> None:
        _fit_some(local, starts, floor_m, yaws, extents, first, threads())

    each(fit, range(threads()))
    return np.asarray(extents)


@njit(
    "Tuple((float64[:,::1], float64[:,:,::1]))"
    "(float32[:,::1], int64[:,::1], int64[::1], float64[:,::1])",
    cache=True,
    nogil=True,
)
def _about_middles(
    points: Floats32, runs: Ints, starts: Ints, middles: Floats
) -> tuple[Floats, Floats]:
    """Returns points (M, 2) about their clusters' middles, cluster by cluster, and extents.

    Of those (C, 2, 3) the heights are written.
    """
    assert points.shape[1] == 3
    local, extents = np.empty((starts[-1], 2)), np.empty((middles.shape[0], 2, 3))
    extents[:, 0, 2], extents[:, 1, 2] = np.inf, -np.inf
    following = starts.copy()
    for run in range(runs.shape[0]):
        label, first, end = runs[run, 0], runs[run, 1], runs[run, 2]
        x_m, y_m, place = middles[label, 0], middles[label, 1], following[label]
        low_m, high_m = extents[label, 0, 2], extents[label, 1, 2]
        following[label] += end - first
        for index in range(first, end):
            z = np.float64(points[index, 2])
            local[place, 0], local[place, 1] = points[index, 0] - x_m, points[index, 1] - y_m
            low_m, high_m = min(low_m, z), max(high_m, z)
            place += 1
        extents[label, 0, 2], extents[label, 1, 2] = low_m, high_m
    return local, extents


@njit(
    "void(float64[:,::1], int64[::1], float64[::1], float64[::1], float64[:,:,::1], int64, int64)",
    cache=True,
    nogil=True,
)
def _fit_some(
    local: Floats,
    starts: Ints,
    floor_m: Floats,
    yaws: Floats,
    extents: Floats,
    begin: int,
    step: int,
) -> None:
    """Turns the yaw of every so many-th cluster, and writes its extents along and across."""
    for index in range(begin, extents.shape[0], step):
        first, end = starts[index], starts[index + 1]
        if end - first >= FEW_POINTS:
            stride = max((end - first) // FIT_POINTS, 1)
            sample = local[first:end:stride].T.astype(np.float32)
            yaws[index] = _direction(np.ascontiguousarray(sample), yaws[index])
        _measure(local[first:end], yaws[index], extents[index])
        sizes = extents[index, 1] - extents[index, 0]
        is_tall = extents[index, 1, 2] - floor_m[index] > TALL_M
        if sizes[1] > (WIDEST_VEHICLE_M if is_tall else WIDE_M) and sizes[1] > sizes[0]:
            yaws[index] += np.pi / 2
            _measure(local[first:end], yaws[index], extents[index])


def overlaps(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Returns the IoU (N, M) of boxes (N, 7) and (M, 7), from above (BEV) and in space (3D)."""
    bev, space = np.zeros((len(a), len(b))), np.zeros((len(a), len(b)))
    _overlaps(np.ascontiguousarray(a, np.float64), np.ascontiguousarray(b, np.float64), bev, space)
    return bev, space


PART = 0.5  # of the smaller box, at a learned detector


def suppress(boxes: Floats, scores: Floats, *, iou: float, part: float = PART) -> Ints:
    """Non-maximum suppression: marks boxes (N, 7) to keep; of two that overlap more, the better.

    A box of which more than a `part` lies in a better one goes, too: a part of a lorry is no
    vehicle of its own.
    """
    order = np.lexsort((*boxes.T[::-1], -scores))
    kept = np.ones(len(boxes), np.bool_)
    _suppress(np.ascontiguousarray(boxes[order], np.float64), iou, part, kept)
    return np.asarray(order[kept])


@njit("float64(float64[::1], float64[::1])", cache=True, nogil=True)
def _common_m2(a: Floats, b: Floats) -> float:
    """Returns the area that two rectangles share: one is clipped by the other's four sides."""
    polygon, clipped = np.empty((16, 2)), np.empty((16, 2))
    turn = b[6] - a[6]
    dx, dy = b[0] - a[0], b[1] - a[1]
    cos, sin = np.cos(a[6]), np.sin(a[6])
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    cos, sin = np.cos(turn), np.sin(turn)
    for corner in range(4):
        u = b[3] / 2 * (1 if corner in (0, 3) else -1)
        v = b[4] / 2 * (1 if corner < 2 else -1)
        polygon[corner, 0], polygon[corner, 1] = x + cos * u - sin * v, y + sin * u + cos * v
    count = 4
    for side in range(4):
        axis, sign, reach = side // 2, 1 - 2 * (side % 2), a[3 + side // 2] / 2
        left = 0
        for i in range(count):
            j = (i + 1) % count
            here, there = reach - sign * polygon[i, axis], reach - sign * polygon[j, axis]
            if here >= 0:
                clipped[left] = polygon[i]
                left += 1
            if (here >= 0) != (there >= 0):
                share = here / (here - there)
                clipped[left] = polygon[i] + share * (polygon[j] - polygon[i])
                left += 1
        polygon, clipped, count = clipped, polygon, left
        if count < 3:
            return 0.0
    area = 0.0
    for i in range(count):
        j = (i + 1) % count
        area += polygon[i, 0] * polygon[j, 1] - polygon[j, 0] * polygon[i, 1]
    return abs(area) / 2


@njit("boolean(float64[::1], float64[::1])", cache=True, nogil=True)
def _near(a: Floats, b: Floats) -> bool:
    reach = (np.hypot(a[3], a[4]) + np.hypot(b[3], b[4])) / 2
    return bool((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 < reach * reach)


@njit("void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1])", cache=True)
def _overlaps(a: Floats, b: Floats, bev: Floats, space: Floats) -> None:
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            if not _near(a[i], b[j]):
                continue
            area = _common_m2(a[i], b[j])
            areas = a[i, 3] * a[i, 4] + b[j, 3] * b[j, 4]
            bev[i, j] = area / max(areas - area, 1e-12)
            top = min(a[i, 2] + a[i, 5] / 2, b[j, 2] + b[j, 5] / 2)
            bottom = max(a[i, 2] - a[i, 5] / 2, b[j, 2] - b[j, 5] / 2)
            volume = area * max(top - bottom, 0.0)
            volumes = a[i, 3] * a[i, 4] * a[i, 5] + b[j, 3] * b[j, 4] * b[j, 5]
            space[i, j] = volume / max(volumes - volume, 1e-12)


@njit("void(float64[:,::1], float64, float64, boolean[::1])", cache=True, nogil=True)
def _suppress(boxes: Floats, iou: float, part: float, kept: Bools) -> None:
    """Goes through boxes in order of their score, best first."""
    for i in range(boxes.shape[0]):
        if not kept[i]:
            continue
        for j in range(i + 1, boxes.shape[0]):
            if kept[j] and _near(boxes[i], boxes[j]):
                area = _common_m2(boxes[i], boxes[j])
                one, other = boxes[i, 3] * boxes[i, 4], boxes[j, 3] * boxes[j, 4]
                is_part = area > part * min(one, other)
                kept[j] = area <= iou * (one + other - area) and not is_part
