"""Partition of the scene between agents: cells of a weighted power diagram (EMP, 2021).

A place belongs to the agent with the least |place - site|^2 - weight (ties to the first). Weights
are in m^2. With b the agent's uplink rate, B the geometric mean of all rates and L the median of
the distances from each site to its nearest neighbour,

    weight = L^2 (b - B) / (b + B)

lies between -L^2 and L^2, whatever the rates. Then weights are lowered until those of any two
agents at the distance D differ by at most D^2 / 2: the border between two agents crosses the line
between them at a quarter to three quarters of D, so that no agent, however fast its uplink, gets
the place where another stands. Equal rates give equal weights, a Voronoi diagram.

REAP draws each border three times: as if one agent's rate were overestimated by alpha and the
other's underestimated, as estimated, and the other way round. The margins are those of the formula
with the distance to the agent's own nearest neighbour for L: about 7 % of the distance between two
far agents for an alpha of 0.3, and every site stays within its tightest cell (alpha up to 0.4).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Ints

TIGHT, PLAIN, WIDE = 0, 1, 2
LEAST_EDGE_M = 1e-6
_STEEPEST = 0.5  # of D^2


def voronoi_weights(sites: Floats) -> Floats:
    """Returns weights (N, 3) that are all equal, for sites (N, 2)."""
    return np.zeros((len(sites), 3))


def power_weights(sites: Floats, mbps: Floats, *, alpha: float) -> Floats:
    """Returns the tight, plain and wide weights (N, 3) in m^2 for sites (N, 2) and rates (N,)."""
    if len(sites) < 2:
        return np.zeros((len(sites), 3))
    apart_m2 = _apart_m2(sites)
    nearest_m2 = (apart_m2 + np.diag(np.full(len(sites), np.inf))).min(axis=1)
    usual_m2 = float(np.median(nearest_m2))
    mean_mbps = float(np.exp(np.log(mbps).mean()))
    pulls = [_pull(mbps * factor, mean_mbps) for factor in (1 - alpha, 1.0, 1 + alpha)]
    plain = _levelled(pulls[PLAIN] * usual_m2, apart_m2 * _STEEPEST)
    below, above = pulls[TIGHT] - pulls[PLAIN], pulls[WIDE] - pulls[PLAIN]
    return np.stack([plain + below * nearest_m2, plain, plain + above * nearest_m2], axis=1)


def cells(sites: Floats, weights_m2: Floats, box: Floats, *, border: int) -> list[Floats]:
    """Returns each agent's cell as a convex polygon (V, 2), CCW; no corners if it is empty.

    Args:
        sites: (N, 2) in m.
        weights_m2: tight, plain and wide (N, 3).
        box: the scene: least x and y, greatest x and y (4,).
        border: `TIGHT`, `PLAIN` or `WIDE`; at a tight border all others have their wide weight.
    """
    corners, counts, _ = _cells(*_arguments(sites, weights_m2, border), box)
    return [corners[i, : counts[i]].copy() for i in range(len(sites))]


def neighbours(sites: Floats, weights_m2: Floats, box: Floats) -> list[tuple[int, int]]:
    """Returns the pairs whose plain cells share a border within the box, each lower index first."""
    corners, counts, origins = _cells(*_arguments(sites, weights_m2, PLAIN), box)
    pairs = set()
    for i in range(len(sites)):
        polygon, origin = corners[i, : counts[i]], origins[i, : counts[i]]
        edges_m = np.linalg.norm(np.roll(polygon, -1, axis=0) - polygon, axis=1)
        for j in origin[edges_m > LEAST_EDGE_M].tolist():
            if j >= 0 and counts[j] > 0:  # of two agents at one place, one has no cell
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def partners(sites: Floats, weights_m2: Floats, box: Floats) -> list[tuple[int, int]]:
    """Returns the pairs that have a space between them: their widest cells meet.

    These are the plain diagram's neighbours and those that a wrong estimate makes neighbours.
    """
    wide = cells(sites, weights_m2, box, border=WIDE)
    bounds = [(p.min(axis=0), p.max(axis=0)) if len(p) else None for p in wide]
    return [
        (i, j)
        for i in range(len(wide))
        for j in range(i + 1, len(wide))
        if _boxes_meet(bounds[i], bounds[j]) and _meet(wide[i], wide[j])
    ]


def _arguments(sites: Floats, weights_m2: Floats, border: int) -> tuple[Floats, Floats, Floats]:
    own, others = weights_m2[:, border], weights_m2[:, WIDE - border]
    places = np.ascontiguousarray(sites, np.float64).reshape(-1, 2)
    return places, np.ascontiguousarray(own), np.ascontiguousarray(others)


def _pull(mbps: Floats, mean_mbps: float) -> Floats:
    return (mbps - mean_mbps) / (mbps + mean_mbps)


def _apart_m2(sites: Floats) -> Floats:
    off = sites[:, None] - sites[None]
    return np.asarray((off**2).sum(axis=-1))


def _levelled(weights_m2: Floats, steps_m2: Floats) -> Floats:
    """Lowers weights (N,) until none exceeds another by more than the step between the two.

    Dijkstra's algorithm from all agents at once: the lowest is processed first.
    """
    lowered, open_ = weights_m2.copy(), np.ones(len(weights_m2), np.bool_)
    for _ in range(len(lowered)):
        least = int(np.argmin(np.where(open_, lowered, np.inf)))
        open_[least] = False
        np.minimum(lowered, lowered[least] + steps_m2[least], out=lowered, where=open_)
    return lowered


def _boxes_meet(a: tuple[Floats, Floats] | None, b: tuple[Floats, Floats] | None) -> bool:
    if a is None or b is None:
        return False
    slack_m = LEAST_EDGE_M
    return bool((a[0] <= b[1] + slack_m).all() and (b[0] <= a[1] + slack_m).all())


def _meet(a: Floats, b: Floats) -> bool:
    """Whether two convex polygons share a place, be it one corner."""
    return not (_separated(a, b) or _separated(b, a))


def _separated(a: Floats, b: Floats) -> bool:
    """Whether an edge of polygon `a` has all of `b` on its outer side."""
    along = np.roll(a, -1, axis=0) - a
    length_m = np.linalg.norm(along, axis=1)
    along, start = along[length_m > LEAST_EDGE_M], a[length_m > LEAST_EDGE_M]
    outward = np.stack([along[:, 1], -along[:, 0]], -1) / length_m[length_m > LEAST_EDGE_M, None]
    beyond_m: Floats = b @ outward.T - (start * outward).sum(axis=1)
    apart: Bools = beyond_m.min(axis=0, initial=np.inf) > LEAST_EDGE_M
    return bool(apart.any())


@njit("int64(float64[:,::1], int64[::1], int64, float64[::1], int64)", cache=True)
def _clip(polygon: Floats, origin: Ints, count: int, line: Floats, label: int) -> int:
    """Keeps of a polygon what has (p - m) . d <= limit; the new edge gets the label."""
    mx, my, dx, dy, limit = line
    before = polygon[:count].copy()
    labels = origin[:count].copy()
    beyond = (before[:, 0] - mx) * dx + (before[:, 1] - my) * dy - limit
    kept = 0
    for here in range(count):
        there = (here + 1) % count
        inside, follows = beyond[here] <= 0, beyond[there] <= 0
        if inside:
            polygon[kept] = before[here]
            origin[kept] = labels[here]
            kept += 1
        if inside != follows:
            share = beyond[here] / (beyond[here] - beyond[there])
            polygon[kept] = before[here] + share * (before[there] - before[here])
            origin[kept] = label if inside else labels[here]
            kept += 1
    return kept


@njit(
    "Tuple((float64[:,:,::1], int64[::1], int64[:,::1]))"
    "(float64[:,::1], float64[::1], float64[::1], float64[::1])",
    cache=True,
)
def _cells(sites: Floats, own: Floats, others: Floats, box: Floats) -> tuple[Floats, Ints, Ints]:
    """Cuts the box, for each agent, along its border with every other.

    Returns corners (N, V, 2), how many there are (N,), and who is on the other side of the edge
    that begins at each corner (N, V), -1 for the box.
    """
    agents = sites.shape[0]
    corners = np.zeros((agents, agents + 4, 2))
    origins = np.full((agents, agents + 4), -1)
    counts = np.zeros(agents, np.int64)
    for i in range(agents):
        polygon, origin = corners[i], origins[i]
        for corner in range(4):
            polygon[corner, 0] = box[0] if corner in (0, 3) else box[2]
            polygon[corner, 1] = box[1] if corner in (0, 1) else box[3]
        count = 4
        for j in range(agents):
            if j == i or count == 0:
                continue
            dx, dy = sites[j, 0] - sites[i, 0], sites[j, 1] - sites[i, 1]
            # |p - i|^2 - own_i <= |p - j|^2 - others_j, with p seen from the middle of the two
            limit = (own[i] - others[j]) / 2
            if dx == 0 and dy == 0:
                if limit < 0 or (limit == 0 and j < i):
                    count = 0
                continue
            mx, my = (sites[i, 0] + sites[j, 0]) / 2, (sites[i, 1] + sites[j, 1]) / 2
            count = _clip(polygon, origin, count, np.array([mx, my, dx, dy, limit]), j)
        counts[i] = count
    return corners, counts, origins
