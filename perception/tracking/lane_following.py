"""Prediction of unseen tracks along lanes: car following, and no passing of a red light.

The mean follows the lane, and the speed what the vehicle ahead allows by the safe speed of Krauss
(1998), as drivers do. Vehicles ahead and behind bound how far off the mean can be.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bools, Bytes, Floats, Ints
from perception.tracking.lane_graph import GO, STOP, likeliest, place_at
from perception.tracking.motion import spread

STEP_S = 0.25  # of motion behind others
ACCEL_MPS2 = 2.0  # of a driver who can
BRAKE_MPS2 = 4.5
REACTION_S = 1.0
STANDSTILL_M = 2.5  # between two that stand
BAR_M = 1.0  # from the stop bar to who stands before it
LOOK_AHEAD_M = 80.0
CREEP_MPS = 1.0  # who is slower stands, and starts only after somebody near
START_M = 12.0
STANDS_MPS = 0.1  # who is slower does not move; it is known as well as this how fast
WIDEST_STD_M = 0.8  # across a lane
CRUISE_S = 1.5  # over which the speed that a driver keeps is the mean
CRUISE_SHARE = 0.5  # of the speed allowed: who is slower is held up
CRUISE_MPS2 = 0.5  # who changes speed more does not keep it ...
FULL_SHARE = 0.9  # ... but for those that are so fast already
CRUISE_STD_MPS = 1.0  # of a speed that is informative
LANE_TURN_RAD = 0.1  # deviation from its heading
GAP_STD_M, GAP_STD_S = 1.0, 0.25  # deviation of the gap of who follows, standing and by speed ...
FOLLOWS_S = 1.5  # ... who has no longer gap, beside that of a standstill


def cruise(
    before: Floats, speed_mps: Floats, accel_mps2: Floats, limit_mps: Floats, dt_s: float
) -> Floats:
    """Returns the shares of the speed allowed that drivers keep where nothing is in the way.

    NaN (N,) as long as that is unknown. Drivers differ in it; who accelerates, brakes or is slow
    shows nothing of it.

    Args:
        before: what this returned for them (N,) when they were last detected.
        speed_mps: of vehicles that are detected (N,).
        accel_mps2: the same.
        limit_mps: what their lanes allow (N,).
        dt_s: since the last frame.
    """
    share = speed_mps / np.maximum(limit_mps, 1e-3)
    keeps = (share > CRUISE_SHARE) & (np.abs(accel_mps2) < CRUISE_MPS2)
    keeps |= (share > FULL_SHARE) & (accel_mps2 > -CRUISE_MPS2)
    kept = np.where(np.isnan(before), share, before)
    kept += (share - kept) * min(dt_s / CRUISE_S, 1.0)
    return np.asarray(np.where(keeps, kept, np.maximum(before, share)))


@njit("float64(float64, float64, float64, float64, boolean, float64)", cache=True)
def _speed(
    v: float, wish_mps: float, gap_m: float, ahead_mps: float, goes: bool, step_s: float
) -> float:
    """Returns the speed after a step, behind a vehicle at this gap; an infinite one is nobody.

    It rises to `wish_mps`, and falls to it as fast as a driver brakes.

    Who stands with nobody near stays, unless it `goes` for a light is green.
    """
    if v < CREEP_MPS and gap_m > START_M and not goes:
        return max(v, 0.0)
    brake = BRAKE_MPS2 * REACTION_S
    room_m = max(gap_m - STANDSTILL_M, 0.0)
    safe = np.sqrt(brake**2 + ahead_mps**2 + 2 * BRAKE_MPS2 * room_m) - brake
    return float(max(0.0, v - BRAKE_MPS2 * step_s, min(v + ACCEL_MPS2 * step_s, wish_mps, safe)))


@njit("Tuple((int64[::1], int64[::1]))(int64[::1], float64[::1], boolean[::1], int64)", cache=True)
def _in_order(lane: Ints, along_m: Floats, solid: Bools, lanes: int) -> tuple[Ints, Ints]:
    """Returns who is next ahead of each on its lane (N,) and first on each lane; -1 for nobody."""
    count = lane.shape[0]
    order = np.argsort(along_m, kind="mergesort")
    next_on = np.full(count, -1, np.int64)
    first_on = np.full(lanes, -1, np.int64)
    for place in range(count - 1, -1, -1):
        n = order[place]
        if lane[n] >= 0:
            next_on[n] = first_on[lane[n]]
            if solid[n]:
                first_on[lane[n]] = n
    return next_on, first_on


@njit(
    "Tuple((float64[::1], int64[::1], boolean[::1]))(float64[:,::1], float64[:,::1], int64[::1], "
    "float64[::1], boolean[::1], float64[::1], int64[::1], int64[::1], float64[::1], uint8[::1])",
    cache=True,
)
def _ahead(
    mean: Floats,
    dims: Floats,
    lane: Ints,
    along_m: Floats,
    solid: Bools,
    length_m: Floats,
    leads: Ints,
    followers: Ints,
    trips: Floats,
    lights: Bytes,
) -> tuple[Floats, Ints, Bools]:
    """Returns the gap to what is next ahead of each on its lane (N,), who that is, and who may go.

    That is a solid track, or the bar of a light (E,) that does not show green, before which one can
    still stop. Those that approach a green light may go.
    """
    count = mean.shape[0]
    next_on, first_on = _in_order(lane, along_m, solid, length_m.shape[0])
    gap_m, ahead = np.full(count, np.inf), np.full(count, -1)
    goes = np.zeros(count, np.bool_)
    for n in range(count):
        if lane[n] < 0:
            continue
        other, way_m, here = next_on[n], -along_m[n], lane[n]
        while other < 0:
            way_m += length_m[here]
            way = likeliest(here, leads, trips)
            if way < 0 or way_m > LOOK_AHEAD_M:
                break
            goes[n] |= lights[way] == GO
            bar_m = way_m - dims[n, 1] / 2
            if lights[way] == STOP and bar_m > mean[n, 3] ** 2 / (2 * BRAKE_MPS2) - BAR_M:
                gap_m[n] = max(bar_m - BAR_M, 0.0) + STANDSTILL_M
                break
            here = followers[way]
            other = first_on[here]
        if other >= 0 and other != n:
            between_m = (dims[n, 1] + dims[other, 1]) / 2
            gap = way_m + along_m[other] - between_m
            if gap < LOOK_AHEAD_M:
                gap_m[n], ahead[n] = gap, other
    return gap_m, ahead, goes


@njit("void(float64[:,::1], float64, float64)", cache=True)
def _turn(p: Floats, turned: float, heading: float) -> None:
    """Turns a covariance with the lane, across which a vehicle cannot be far off."""
    turn = np.eye(6)
    turn[0, 0] = turn[1, 1] = np.cos(turned)
    turn[1, 0], turn[0, 1] = np.sin(turned), -np.sin(turned)
    spread(turn, p)
    cos, sin = np.cos(heading), np.sin(heading)
    across = p[0, 0] * sin**2 - 2 * p[0, 1] * sin * cos + p[1, 1] * cos**2
    k = min(WIDEST_STD_M / np.sqrt(max(across, 1e-9)), 1.0) - 1
    shrunk = np.eye(6)
    shrunk[0, 0] += k * sin * sin
    shrunk[1, 1] += k * cos * cos
    shrunk[0, 1] = shrunk[1, 0] = -k * sin * cos
    shrunk[2, 2] = min(LANE_TURN_RAD / np.sqrt(max(p[2, 2], 1e-9)), 1.0)
    spread(shrunk, p)


@njit("float64(float64[:,:], float64)", cache=True)
def _along_m2(p: Floats, heading: float) -> float:
    """Returns the variance of the position along a heading."""
    cos, sin = np.cos(heading), np.sin(heading)
    return float(p[0, 0] * cos**2 + 2 * p[0, 1] * sin * cos + p[1, 1] * sin**2)


@njit(
    "void(float64[:,::1], float64[:,:,::1], boolean[::1], boolean[::1], float64[::1], int64[::1])",
    cache=True,
)
def _bound(
    mean: Floats, covariance: Floats, seen: Bools, solid: Bools, gap_m: Floats, ahead: Ints
) -> None:
    """Bounds the deviations along of hidden tracks that others leave no room for.

    Who follows a vehicle that is seen keeps the gap to it within limits, whatever that does; and
    who has one before and one behind is between them. Where there is no room for it, nothing is
    known. `gap_m` and `ahead` are of `_ahead`.
    """
    count = mean.shape[0]
    behind = np.full(count, -1)
    along_m2 = np.empty(count)
    for n in range(count):
        along_m2[n] = _along_m2(covariance[n], mean[n, 2])
        leader = ahead[n]
        if solid[n] and leader >= 0 and (behind[leader] < 0 or gap_m[n] < gap_m[behind[leader]]):
            behind[leader] = n
    shrunk = np.eye(6)
    for n in range(count):
        leader, follower = ahead[n], behind[n]
        room_m = gap_m[n] + gap_m[follower] if follower >= 0 else np.inf
        if seen[n] or leader < 0 or room_m < 0.0:
            continue
        heading, v, most = mean[n, 2], max(mean[n, 3], 0.0), np.inf
        if seen[leader] and gap_m[n] < STANDSTILL_M + FOLLOWS_S * v:
            most = along_m2[leader] + (GAP_STD_M + GAP_STD_S * v) ** 2
        if follower >= 0:
            most = min(most, max(along_m2[leader], along_m2[follower]) + room_m**2 / 12)
        if along_m2[n] > most:
            k = np.sqrt(most / along_m2[n]) - 1
            cos, sin = np.cos(heading), np.sin(heading)
            shrunk[0, 0], shrunk[1, 1] = 1 + k * cos * cos, 1 + k * sin * sin
            shrunk[0, 1] = shrunk[1, 0] = k * sin * cos
            spread(shrunk, covariance[n])


_GRAPH = "float64[:,::1], int64[::1], float64[::1], float64[::1], int64[::1], int64[::1]"


@njit(
    "void(float64[:,::1], float64[:,:,::1], float64[:,::1], int64[::1], float64[::1], float64[::1],"
    " float64[::1], float64[::1], float64, boolean[::1], boolean[::1], boolean[::1],"
    f" boolean[::1], {_GRAPH}, float64[::1], uint8[::1])",
    cache=True,
)
def follow_lanes(
    mean: Floats,
    covariance: Floats,
    dims: Floats,
    lane: Ints,
    along_m: Floats,
    off_m: Floats,
    share: Floats,
    cruise: Floats,
    dt_s: float,
    free: Bools,
    seen: Bools,
    solid: Bools,
    known: Bools,
    segments: Floats,
    first: Ints,
    length_m: Floats,
    speed_mps: Floats,
    leads: Ints,
    followers: Ints,
    trips: Floats,
    lights: Bytes,
) -> None:
    """Moves the means of tracks that are not free along their lanes, behind those ahead of them.

    Solid ones stand in the way of those behind them; free ones do only that. Of those that were not
    `seen` in the last frame, who does not move is taken to stand if it is `known`, by enough
    detections, or waits behind another or before a bar; others bound the error of its mean.
    `dims` (N, 4) are z, length, width, height; `cruise` (N,) of `TrackStates`, `lights` (E,) of
    `LaneGraph.lights`. `share` (N,) is multiplied by the probability of the way taken at each fork,
    and becomes 0 where a lane ends on the map.
    """
    count = mean.shape[0]
    left_s = dt_s
    while left_s > 1e-9:
        step_s = min(STEP_S, left_s)
        left_s -= step_s
        gap_m, ahead, goes = _ahead(
            mean, dims, lane, along_m, solid, length_m, leads, followers, trips, lights
        )
        speeds = mean[:, 3].copy()
        for n in range(count):
            if lane[n] < 0:
                continue
            v = speeds[n]
            if not free[n]:
                limit = speed_mps[lane[n]]
                wish = max(v, limit) if np.isnan(cruise[n]) else cruise[n] * limit
                ahead_mps = max(speeds[ahead[n]], 0.0) if ahead[n] >= 0 else 0.0
                v = _speed(v, wish, gap_m[n], ahead_mps, goes[n], step_s)
                mean[n, 3] = v
            along_m[n] += v * step_s
            while along_m[n] > length_m[lane[n]]:
                way = likeliest(lane[n], leads, trips)
                if way < 0:
                    if not free[n]:
                        share[n] = 0.0
                    along_m[n] = length_m[lane[n]]
                    break
                if not free[n]:
                    ways = trips[leads[lane[n]] : leads[lane[n] + 1]]
                    share[n] *= trips[way] / ways.sum()
                along_m[n] -= length_m[lane[n]]
                lane[n] = followers[way]
    gap_m, ahead, _ = _ahead(
        mean, dims, lane, along_m, solid, length_m, leads, followers, trips, lights
    )
    for n in range(count):
        if free[n]:
            continue
        x, y, z, heading = place_at(lane[n], along_m[n], segments, first)
        mean[n, 0] = x - off_m[n] * np.sin(heading)
        mean[n, 1] = y + off_m[n] * np.cos(heading)
        dims[n, 0] = z + dims[n, 3] / 2
        turned = heading - mean[n, 2]
        mean[n, 2], mean[n, 4] = heading, 0.0
        _turn(covariance[n], turned, heading)
        waits = gap_m[n] <= START_M and (ahead[n] < 0 or mean[ahead[n], 3] < CREEP_MPS)
        if not seen[n] and mean[n, 3] < STANDS_MPS and (waits or known[n]):
            stands = np.eye(6)
            stands[3, 3] = min(STANDS_MPS / np.sqrt(max(covariance[n, 3, 3], 1e-9)), 1.0)
            spread(stands, covariance[n])
    _bound(mean, covariance, seen, solid, gap_m, ahead)
