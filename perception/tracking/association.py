"""Data association: detections to tracks, by a global assignment within gates."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bools, Bytes, Floats, Ints
from protocol.messages import ObjectClass

PERSON = int(ObjectClass.PEDESTRIAN)
SIZE_STD = 0.4  # of the logarithm of a length: boxes of one vehicle differ by its seen side
SMALL_M = 2.6  # what is longer is no person; a bicycle may be taken for one
TURNED_RAD = 0.9  # a vehicle that is not confirmed is not turned by more
OTHER_COST = 4.0  # of a person taken for a two-wheeler
JUMP_COST = 4.0  # of a box that is a track's own only if it jumped
UNSURE_COST = 3.0  # of a track that is not confirmed
ALONE_COST = 15.0  # of a box and a track of several that could be paired, and stay alone
LEAST_LIMIT = 1e-6  # above the cheapest pair, so that no cost outside the gates is below it


def associate(
    mean: Floats,
    covariance: Floats,
    traits: Floats,
    boxes: Floats,
    std: Floats,
    jump_std: Floats,
    gate: float,
) -> tuple[Ints, Bools]:
    """Returns for each box the track that it belongs to, an index or -1, and whether that jumped.

    The sum of costs is the least: squared Mahalanobis distance, the logarithm of the determinant of
    its covariance, so that certain tracks come first, differences in size, the track's existence.
    What lies outside a track's gate may be its own if it jumped, at a cost.

    Args:
        mean: states (N, 6) as in `motion`, with covariances (N, 6, 6).
        covariance: see `mean`.
        traits: of each track (N, 5) length, whether it is a person, existence, whether confirmed,
            whether on a lane.
        boxes: (M, 9): as detected, whether it is a person, whether along a lane.
        std: deviations along, across and in heading (M, 3).
        jump_std: deviations along and across of jumps of each kind (K, 2).
        gate: the largest squared distance.
    """
    result, jumped = np.full(len(boxes), -1, np.int64), np.zeros(len(boxes), np.bool_)
    if not len(mean) or not len(boxes):
        return result, jumped
    box, track, cost, jumps = _pairs(mean, covariance, traits, boxes, std, jump_std, gate)
    if not len(box):
        return result, jumped
    limit = max(ALONE_COST - cost.min(), LEAST_LIMIT)
    part = _parts(box, track, len(boxes), len(mean))
    order = np.argsort(part, kind="stable")
    ends = np.flatnonzero(np.diff(part[order], append=-1)) + 1
    chosen = _cheapest(box[order], track[order], (cost - cost.min())[order], ends, limit)
    pairs = order[chosen]
    result[box[pairs]], jumped[box[pairs]] = track[pairs], jumps[pairs]
    return result, jumped


@njit(cache=True)
def _grown(column, room):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - of any type
    longer = np.empty(room, column.dtype)
    longer[: len(column)] = column
    return longer


@njit("UniTuple(float64, 2)(float64, float64, float64, float64, float64)", cache=True)
def _distance2(x: float, y: float, xx: float, yy: float, xy: float) -> tuple[float, float]:
    """Returns the squared Mahalanobis distance of (x, y), and the determinant of its covariance."""
    det = xx * yy - xy * xy
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / det, det


@njit("UniTuple(float64, 3)(float64, float64, float64)", cache=True)
def _spread(yaw: float, along_m: float, across_m: float) -> tuple[float, float, float]:
    """Returns xx, yy, xy of the covariance of deviations along and across a heading."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    a, b = along_m * along_m, across_m * across_m
    return a * cos * cos + b * sin * sin, a * sin * sin + b * cos * cos, (a - b) * cos * sin


@njit("boolean(float64, float64[::1], float64[::1])", cache=True)
def _may_be(yaw: float, traits: Floats, box: Floats) -> bool:
    """Whether a box (9,) may be of a track (5,) by its kind and heading: see `associate`."""
    if traits[1] != box[7] and max(traits[0], box[3]) > SMALL_M:
        return False
    if traits[3] != 0.0 or min(traits[0], box[3]) <= SMALL_M:
        return True
    return bool(abs((box[6] - yaw + np.pi / 2) % np.pi - np.pi / 2) <= TURNED_RAD)


@njit(
    "UniTuple(float64, 2)(float64, float64, UniTuple(float64, 3), float64, float64[:,::1])",
    cache=True,
)
def _jump2(
    x: float, y: float, spread: tuple[float, float, float], yaw: float, jump_std: Floats
) -> tuple[float, float]:
    """Returns what `_distance2` does, with the kind of jump (K, 2) by which it is the least."""
    least, least_det = np.inf, 1.0
    for kind in range(jump_std.shape[0]):
        xx, yy, xy = _spread(yaw, jump_std[kind, 0], jump_std[kind, 1])
        d2, det = _distance2(x, y, spread[0] + xx, spread[1] + yy, spread[2] + xy)
        if d2 < least:
            least, least_det = d2, det
    return least, least_det


@njit(
    "Tuple((int64[::1], int64[::1], float64[::1], boolean[::1]))(float64[:,::1], float64[:,:,::1], "
    "float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1], float64)",
    cache=True,
)
def _pairs(
    mean: Floats,
    covariance: Floats,
    traits: Floats,
    boxes: Floats,
    std: Floats,
    jump_std: Floats,
    gate: float,
) -> tuple[Ints, Ints, Floats, Bools]:
    """Returns the pairs of box and track within the gate, their costs, and which are jumps."""
    room = 4 * (mean.shape[0] + boxes.shape[0]) + 16
    box, track, cost = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
    jumps = np.empty(room, np.bool_)
    count = 0
    jump2 = (jump_std**2).sum(axis=1).max()
    by_x = np.argsort(boxes[:, 0])
    sorted_x, most_std2 = boxes[by_x, 0], (std[:, 0] ** 2).max()
    for n in range(mean.shape[0]):
        p = covariance[n]
        reach2 = gate * (p[0, 0] + p[1, 1] + jump2 + 2.0)
        doubt = -2 * np.log(max(traits[n, 2], 1e-3)) + (0.0 if traits[n, 3] else UNSURE_COST)
        far = np.sqrt(reach2 + gate * most_std2)
        first = np.searchsorted(sorted_x, mean[n, 0] - far)
        for m in by_x[first : np.searchsorted(sorted_x, mean[n, 0] + far, side="right")]:
            x, y = boxes[m, 0] - mean[n, 0], boxes[m, 1] - mean[n, 1]
            if x * x + y * y > reach2 + gate * std[m, 0] ** 2:
                continue
            is_other = traits[n, 1] != boxes[m, 7]
            if not _may_be(mean[n, 2], traits[n], boxes[m]):
                continue
            xx, yy, xy = _spread(boxes[m, 6], std[m, 0], std[m, 1])
            xx, yy, xy = p[0, 0] + xx, p[1, 1] + yy, p[0, 1] + xy
            d2, det = _distance2(x, y, xx, yy, xy)
            is_jump = d2 > gate
            if is_jump:
                if traits[n, 4] and boxes[m, 8] and np.cos(boxes[m, 6] - mean[n, 2]) < 0.0:
                    continue  # nobody changes to an oncoming lane
                d2, det = _jump2(x, y, (xx, yy, xy), mean[n, 2], jump_std)
                if d2 > gate:
                    continue
            longer = np.log(max(boxes[m, 3], 0.3) / max(traits[n, 0], 0.3)) / SIZE_STD
            if count == room:
                room *= 2
                box, track, cost = _grown(box, room), _grown(track, room), _grown(cost, room)
                jumps = _grown(jumps, room)
            box[count], track[count], jumps[count] = m, n, is_jump
            cost[count] = d2 + np.log(det) + min(longer**2, 9.0) + doubt
            cost[count] += (JUMP_COST if is_jump else 0.0) + (OTHER_COST if is_other else 0.0)
            count += 1
    return box[:count].copy(), track[:count].copy(), cost[:count].copy(), jumps[:count].copy()


@njit("int64[::1](int64[::1], int64[::1], int64, int64)", cache=True)
def _parts(box: Ints, track: Ints, boxes: int, tracks: int) -> Ints:
    """Returns the connected part of the graph that each pair belongs to (union-find)."""
    root = np.arange(boxes + tracks)
    for pair in range(len(box)):
        a, b = box[pair], boxes + track[pair]
        while root[a] != a:
            root[a] = root[root[a]]
            a = root[a]
        while root[b] != b:
            root[b] = root[root[b]]
            b = root[b]
        root[max(a, b)] = min(a, b)
    part = np.empty(len(box), np.int64)
    for pair in range(len(box)):
        a = box[pair]
        while root[a] != a:
            a = root[a]
        part[pair] = a
    return part


@njit("void(int64[::1], int64[::1], int64[::1], int64, int64)", cache=True)
def _augment(of_row: Ints, of_column: Ints, before: Ints, column: int, first: int) -> None:
    """Shifts the rows along an augmenting path, from its last column back to the row `first`."""
    while column >= 0:
        ahead = before[column]
        of_column[column] = of_column[ahead] if ahead >= 0 else first
        of_row[of_column[column]] = column
        column = ahead


@njit("int64[::1](float64[:,::1])", cache=True)
def assign(costs: Floats) -> Ints:
    """Returns the column of each row (R,) such that the sum of `costs` (R, C) is minimal.

    By shortest augmenting paths, row by row (Jonker and Volgenant 1987, without their
    initialisation). `lapx` takes 76 us for ten rows, most of it call overhead; this takes 15.

    Raises:
        ValueError: there are fewer columns than rows, or no finite cost is left for a row.
    """
    rows, columns = costs.shape
    row_price, column_price = np.zeros(rows), np.zeros(columns)
    of_column, of_row = np.full(columns, -1), np.full(rows, -1)
    least, before, done = (
        np.empty(columns),
        np.empty(columns, np.int64),
        np.empty(columns, np.bool_),
    )
    for first in range(rows):
        least[:], before[:], done[:] = np.inf, -1, False
        row, column = first, -1
        while row >= 0:
            step, nearest = np.inf, -1
            for other in range(columns):
                if done[other]:
                    continue
                value = costs[row, other] - row_price[row] - column_price[other]
                if value < least[other]:
                    least[other], before[other] = value, column
                if least[other] < step:
                    step, nearest = least[other], other
            if nearest < 0:
                raise ValueError("no column is left for a row")
            row_price[first] += step
            for other in range(columns):
                if done[other]:
                    row_price[of_column[other]] += step
                    column_price[other] -= step
                else:
                    least[other] -= step
            column = nearest
            done[column] = True
            row = of_column[column]
        _augment(of_row, of_column, before, column, first)
    return of_row


@njit(
    "boolean[::1](int64[::1], int64[::1], float64[::1], int64[::1], float64)",
    cache=True,
)
def _cheapest(box: Ints, track: Ints, cost: Floats, ends: Ints, limit: float) -> Bools:
    """Marks the pairs of the assignment of least cost, part by part; each part ends at `ends`.

    A part's only pair is always chosen. In other parts a box stays alone for a cost of `limit`.
    """
    chosen = np.zeros(len(box), np.bool_)
    row_of, column_of = np.full(box.max() + 1, -1), np.full(track.max() + 1, -1)
    start = 0
    for end in ends:
        if end - start == 1:
            chosen[start] = True
            start = end
            continue
        rows = columns = 0
        for pair in range(start, end):
            if row_of[box[pair]] < 0:
                row_of[box[pair]] = rows
                rows += 1
            if column_of[track[pair]] < 0:
                column_of[track[pair]] = columns
                columns += 1
        costs = np.full((rows, columns + rows), 4 * limit)
        costs[:, columns:] = limit
        for pair in range(start, end):
            costs[row_of[box[pair]], column_of[track[pair]]] = cost[pair]
        of_row = assign(costs)
        for pair in range(start, end):
            chosen[pair] = of_row[row_of[box[pair]]] == column_of[track[pair]]
        start = end
    return chosen


def is_person(classes: Bytes) -> Floats:
    """Returns 1 for people and 0 for vehicles (N,), as `associate` takes it."""
    return np.asarray(classes == PERSON, np.float64)
