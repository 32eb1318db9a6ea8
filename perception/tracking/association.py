"""Association: which detection is whose, by a global assignment within gates."""

from __future__ import annotations

import lap
import numpy as np
from numba import njit

from perception.arrays import Bytes, Floats, Ints
from protocol.messages import ObjectClass

PERSON = int(ObjectClass.PEDESTRIAN)
SIZE_STD = 0.4  # of the logarithm of a length: boxes of one vehicle differ by its seen side
SMALL_M = 2.6  # what is longer is no person; a bicycle may be taken for one
OTHER_COST = 4.0  # of a person taken for a two-wheeler
UNMATCHED_COST = 10.0  # over the gate: whoever can be paired is paired


def associate(
    mean: Floats,
    covariance: Floats,
    sizes: Floats,
    existence: Floats,
    boxes: Floats,
    std: Floats,
    gate: float,
) -> Ints:
    """Returns for each box the track that it belongs to, an index or -1.

    The sum of costs is the least: squared Mahalanobis distance, the logarithm of the determinant of
    its covariance, so that certain tracks come first, differences in size, doubts about the track.

    Args:
        mean: states (N, 5) as in `motion`, with covariances (N, 5, 5).
        covariance: see `mean`.
        sizes: length of each track and whether it is a person (N, 2).
        existence: of each track (N,).
        boxes: (M, 8): as detected, and whether it is a person.
        std: deviations along, across and in heading (M, 3).
        gate: the largest squared distance.
    """
    result = np.full(len(boxes), -1, np.int64)
    if not len(mean) or not len(boxes):
        return result
    box, track, cost = _pairs(mean, covariance, sizes, existence, boxes, std, gate)
    if not len(box):
        return result
    cost -= cost.min()
    limit = float(cost.max()) + gate + UNMATCHED_COST
    part = _parts(box, track, len(boxes), len(mean))
    order = np.argsort(part, kind="stable")
    starts = np.flatnonzero(np.diff(part[order], prepend=-1))
    ends = np.append(starts[1:], len(order))
    single = order[starts[ends - starts == 1]]
    result[box[single]] = track[single]
    for start, end in zip(starts, ends, strict=True):
        if end - start == 1:
            continue
        chosen = order[start:end]
        rows, row = np.unique(box[chosen], return_inverse=True)
        columns, column = np.unique(track[chosen], return_inverse=True)
        costs = np.full((len(rows), len(columns)), 4 * limit)
        costs[row, column] = cost[chosen]
        _, of_row, _ = lap.lapjv(costs, extend_cost=True, cost_limit=2 * limit)
        is_paired = of_row >= 0
        result[rows[is_paired]] = columns[of_row[is_paired]]
    return result


@njit(cache=True)
def _grown(column, room):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - of any type
    longer = np.empty(room, column.dtype)
    longer[: len(column)] = column
    return longer


@njit(
    "Tuple((int64[::1], int64[::1], float64[::1]))(float64[:,::1], float64[:,:,::1], "
    "float64[:,::1], float64[::1], float64[:,::1], float64[:,::1], float64)",
    cache=True,
)
def _pairs(
    mean: Floats,
    covariance: Floats,
    sizes: Floats,
    existence: Floats,
    boxes: Floats,
    std: Floats,
    gate: float,
) -> tuple[Ints, Ints, Floats]:
    """Returns the pairs of box and track within the gate, and their costs."""
    room = 4 * (mean.shape[0] + boxes.shape[0]) + 16
    box, track, cost = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
    count = 0
    for n in range(mean.shape[0]):
        p = covariance[n]
        reach2 = gate * (p[0, 0] + p[1, 1] + 2.0)
        for m in range(boxes.shape[0]):
            x, y = boxes[m, 0] - mean[n, 0], boxes[m, 1] - mean[n, 1]
            if x * x + y * y > reach2 + gate * std[m, 0] ** 2:
                continue
            is_other = sizes[n, 1] != boxes[m, 7]
            if is_other and max(sizes[n, 0], boxes[m, 3]) > SMALL_M:
                continue
            cos, sin = np.cos(boxes[m, 6]), np.sin(boxes[m, 6])
            along, across = std[m, 0] ** 2, std[m, 1] ** 2
            xx = p[0, 0] + along * cos * cos + across * sin * sin
            yy = p[1, 1] + along * sin * sin + across * cos * cos
            xy = p[0, 1] + (along - across) * cos * sin
            det = xx * yy - xy * xy
            d2 = (yy * x * x - 2 * xy * x * y + xx * y * y) / det
            if d2 > gate:
                continue
            longer = np.log(max(boxes[m, 3], 0.3) / max(sizes[n, 0], 0.3)) / SIZE_STD
            if count == room:
                room *= 2
                box, track, cost = _grown(box, room), _grown(track, room), _grown(cost, room)
            box[count], track[count] = m, n
            cost[count] = (
                d2
                + np.log(det)
                + min(longer**2, 9.0)
                - 2 * np.log(max(existence[n], 1e-3))
                + (OTHER_COST if is_other else 0.0)
            )
            count += 1
    return box[:count].copy(), track[:count].copy(), cost[:count].copy()


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


def is_person(classes: Bytes) -> Floats:
    """Returns 1 for people and 0 for vehicles (N,), as `associate` takes it."""
    return np.asarray(classes == PERSON, np.float64)
