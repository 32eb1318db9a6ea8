"""Motion of tracks: constant turn rate and speed in the open, along the lanes where there are some.

A state is x, y, heading, speed along it, yaw rate and acceleration, with a covariance (6, 6): the
extended Kalman filter of a constant turn rate and acceleration (Schubert et al. 2008), where the
acceleration fades (Singer 1970). On a lane, the mean follows the lane, and the speed what the
vehicle ahead allows by the safe speed of Krauss (1998), as drivers do.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Ints
from perception.tracking.lane_graph import likeliest, place_at

STEP_S = 0.25  # of motion behind others
ACCEL_MPS2 = 1.5  # of a driver who can
BRAKE_MPS2 = 4.5
REACTION_S = 1.0
STANDSTILL_M = 2.5  # between two that stand
LOOK_AHEAD_M = 80.0
CREEP_MPS = 1.0  # who is slower stands, and starts only after somebody near
START_M = 12.0
STANDS_MPS = 0.1  # who is slower does not move; it is known as well as this how fast
WIDEST_STD_M = 0.8  # across a lane
LANE_TURN_RAD = 0.1  # deviation from its heading
JUMP_STD = np.array([1.5, 1.3, 2.0])  # along, across (a lane is 3.5 m wide), in speed
JUMP_STD_OFF_MAP = np.array([0.5, 0.5, 1.0])
TURN_LIFE_S = 1.0  # of a yaw rate: curves end
ACCEL_LIFE_S = 2.0  # of an acceleration
FIRST_ACCEL_MPS2 = 1.5
JERK_PART = 0.02
ABEAM_M = 1.0  # beyond a box's end: a sensor that stands there sees its side
ROBUST = 2.0
SLOW_MPS = 0.4
SLOW_STD_MPS = 0.4

_STATE = "float64[:,::1], float64[:,:,::1]"


@njit("void(float64[:,:], float64[:,:])", cache=True)
def _spread(f: Floats, p: Floats) -> None:
    """Sets a covariance p (6, 6) to f p f^T; in loops, as a product of matrices would need BLAS."""
    half = np.zeros((6, 6))
    for i in range(6):
        for k in range(6):
            if f[i, k] != 0.0:
                for j in range(6):
                    half[i, j] += f[i, k] * p[k, j]
    for i in range(6):
        for j in range(i, 6):
            total = 0.0
            for k in range(6):
                total += half[i, k] * f[j, k]
            p[i, j] = p[j, i] = total


@njit("void(float64[::1], float64[:,::1], float64[::1], float64, float64)", cache=True)
def _correct_by(mean: Floats, p: Floats, axis: Floats, off: float, variance: float) -> None:
    """Corrects a state by one number: its part along an axis (6,) is off by so much."""
    gain = np.zeros(6)
    for i in range(6):
        for j in range(6):
            gain[i] += p[i, j] * axis[j]
    total = variance
    for i in range(6):
        total += axis[i] * gain[i]
    for i in range(6):
        mean[i] += gain[i] * off / total
    for i in range(6):
        for j in range(6):
            p[i, j] -= gain[i] * gain[j] / total


TUNE = np.array([4.0, 1.5, 0.02, 3.0, 0, 0, 0, 1.0, 2.5, 0, 0.3, 0.005])


@njit(f"void({_STATE}, float64, float64[::1], float64, boolean[::1], boolean[::1], float64[::1])", cache=True)
def predict(
    mean: Floats,
    covariance: Floats,
    dt_s: float,
    accel_mps2: Floats,
    turn_rps: float,
    free: Bools,
    steady: Bools,
    tune: Floats,
) -> None:
    """Moves states (N, 6) and their covariances (N, 6, 6) on; means only of those that are free.

    Of those that are `steady`, the deviation `accel_mps2` (N,) is that of the speed after 1 s; of
    others it is that of the acceleration.
    """
    f = np.eye(6)
    fade = np.exp(-dt_s / tune[0])
    for n in range(mean.shape[0]):
        yaw, v, w, a = mean[n, 2], mean[n, 3], mean[n, 4], mean[n, 5]
        if steady[n] or not free[n]:
            a = 0.0
        if v + a * dt_s < 0.0 <= v:
            a = -v / dt_s
        way_m = v * dt_s + 0.5 * a * dt_s**2
        middle = yaw + (0.5 * w * dt_s if free[n] else 0.0)
        cos, sin = np.cos(middle), np.sin(middle)
        f[0, 2], f[0, 3], f[0, 4] = -way_m * sin, dt_s * cos, -0.5 * way_m * dt_s * sin
        f[1, 2], f[1, 3], f[1, 4] = way_m * cos, dt_s * sin, 0.5 * way_m * dt_s * cos
        f[2, 4] = dt_s
        f[4, 4] = np.exp(-dt_s / TURN_LIFE_S)
        coupled = 0.0 if steady[n] else 1.0
        f[0, 5], f[1, 5] = 0.5 * coupled * dt_s**2 * cos, 0.5 * coupled * dt_s**2 * sin
        f[3, 5], f[5, 5] = coupled * dt_s, coupled * fade
        p = covariance[n]
        _spread(f, p)
        q = accel_mps2[n] ** 2 if steady[n] else tune[2] * accel_mps2[n] ** 2
        along = q * dt_s**3 / 3
        p[0, 0] += along * cos * cos + 0.01 * dt_s
        p[1, 1] += along * sin * sin + 0.01 * dt_s
        p[0, 1] += along * cos * sin
        p[1, 0] += along * cos * sin
        for axis, part in ((0, cos), (1, sin)):
            p[axis, 3] += 0.5 * q * dt_s**2 * part
            p[3, axis] += 0.5 * q * dt_s**2 * part
        p[3, 3] += q * dt_s
        if steady[n]:
            p[5, 5] = tune[1]**2
        else:
            p[5, 5] += accel_mps2[n] ** 2 * (1 - fade**2)
        p[2, 2] += 1e-3 * dt_s
        p[4, 4] += turn_rps**2 * dt_s
        mean[n, 5] = coupled * a * fade
        if free[n]:
            mean[n, 0] += way_m * cos
            mean[n, 1] += way_m * sin
            mean[n, 2] = yaw + w * dt_s
            mean[n, 3] = v + a * dt_s
            mean[n, 4] = w * f[4, 4]


@njit(
    f"void({_STATE}, float64[::1], int64[::1], float64[:,::1], float64[:,::1], float64[:,::1], float64[::1])",
    cache=True,
)
def correct(
    mean: Floats,
    covariance: Floats,
    length_m: Floats,
    tracks: Ints,
    boxes: Floats,
    std: Floats,
    seen: Floats,
    tune: Floats,
) -> None:
    """Corrects some states by boxes (M, 7) of deviations along, across and in heading (M, 3).

    A box's heading may be the wrong way round; a vehicle that goes backwards for good has been
    taken for the wrong way round itself. `seen` (M, 2) is how far ahead of a box's middle the
    sensor stands that sees it, and how far its near end may lie beyond the vehicle's own. What
    counts is the end that is turned to the sensor, as of a vehicle of `length_m` (N,): the other
    one is hidden. A box that ends farther from the sensor than expected is less sure: parts are
    hidden, or lie between two beams, but nothing of a vehicle is where it is not.
    """
    axes = np.zeros((3, 6))
    axes[2, 2] = 1.0
    for m in range(tracks.shape[0]):
        n = tracks[m]
        p = covariance[n]
        cos, sin = np.cos(boxes[m, 6]), np.sin(boxes[m, 6])
        axes[0, 0], axes[0, 1], axes[1, 0], axes[1, 1] = cos, sin, -sin, cos
        side = 0.0
        if abs(seen[m, 0]) > boxes[m, 3] / 2 + ABEAM_M:
            side = np.sign(seen[m, 0])
        for axis in range(2):
            x, y = boxes[m, 0] - mean[n, 0], boxes[m, 1] - mean[n, 1]
            off, deviation = axes[axis, 0] * x + axes[axis, 1] * y, std[m, axis]
            if axis == 0:
                if seen[m, 2] == 0.0:
                    deviation = tune[10] + tune[11] * seen[m, 1]
                off += tune[7] * side * (boxes[m, 3] - length_m[n]) / 2
                total = deviation**2
                for i in range(2):
                    for j in range(2):
                        total += axes[0, i] * p[i, j] * axes[0, j]
                far = abs(off) / np.sqrt(total)
                if seen[m, 2] == 0.0:
                    if side * off < 0.0:
                        deviation *= 1.0 + (far / tune[8]) ** 2
                    elif far > tune[3]:
                        deviation *= np.sqrt(far / tune[3])
            _correct_by(mean[n], p, axes[axis], off, deviation**2)
        turned = (boxes[m, 6] - mean[n, 2] + np.pi / 2) % np.pi - np.pi / 2
        _correct_by(mean[n], p, axes[2], turned, std[m, 2] ** 2)
        if mean[n, 3] < -2.0:
            mean[n, 2] += np.pi
            mean[n, 3] = -mean[n, 3]
            mean[n, 5] = -mean[n, 5]
            for i in (3, 5):
                p[i, :] *= -1
                p[:, i] *= -1
        mean[n, 2] = (mean[n, 2] + np.pi) % (2 * np.pi) - np.pi


@njit("float64(float64, float64, float64, float64, float64)", cache=True)
def _speed(v: float, limit_mps: float, gap_m: float, ahead_mps: float, step_s: float) -> float:
    """Returns the speed after a step, behind a vehicle at this gap; an infinite one is nobody."""
    if v < CREEP_MPS and gap_m > START_M:
        return max(v, 0.0)
    wish = max(v, limit_mps)
    brake = BRAKE_MPS2 * REACTION_S
    room_m = max(gap_m - STANDSTILL_M, 0.0)
    safe = np.sqrt(brake**2 + ahead_mps**2 + 2 * BRAKE_MPS2 * room_m) - brake
    return float(max(0.0, v - BRAKE_MPS2 * step_s, min(v + ACCEL_MPS2 * step_s, wish, safe)))


@njit(
    "Tuple((float64[::1], float64[::1]))(float64[:,::1], float64[:,::1], int64[::1], float64[::1], "
    "boolean[::1], float64[::1], int64[::1], int64[::1], float64[::1])",
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
) -> tuple[Floats, Floats]:
    """Returns the gap to who is next ahead on the lane of each (N,), and the speed of that one.

    Only solid ones count. `first_on` is who is first on each lane.
    """
    count, lanes = mean.shape[0], length_m.shape[0]
    order = np.argsort(along_m, kind="mergesort")
    next_on = np.full(count, -1, np.int64)
    first_on = np.full(lanes, -1, np.int64)
    for place in range(count - 1, -1, -1):
        n = order[place]
        if lane[n] >= 0:
            next_on[n] = first_on[lane[n]]
            if solid[n]:
                first_on[lane[n]] = n
    gap_m, ahead_mps = np.full(count, np.inf), np.zeros(count)
    for n in range(count):
        if lane[n] < 0:
            continue
        other, way_m, here = next_on[n], -along_m[n], lane[n]
        while other < 0:
            way_m += length_m[here]
            way = likeliest(here, leads, trips)
            if way < 0 or way_m > LOOK_AHEAD_M:
                break
            here = followers[way]
            other = first_on[here]
        if other >= 0 and other != n:
            between_m = (dims[n, 1] + dims[other, 1]) / 2
            gap = way_m + along_m[other] - between_m
            if gap < LOOK_AHEAD_M:
                gap_m[n], ahead_mps[n] = max(gap, 0.0), max(mean[other, 3], 0.0)
    return gap_m, ahead_mps


@njit("void(float64[:,::1], float64, float64)", cache=True)
def _turn(p: Floats, turned: float, heading: float) -> None:
    """Turns a covariance with the lane, across which a vehicle cannot be far off."""
    turn = np.eye(6)
    turn[0, 0] = turn[1, 1] = np.cos(turned)
    turn[1, 0], turn[0, 1] = np.sin(turned), -np.sin(turned)
    _spread(turn, p)
    cos, sin = np.cos(heading), np.sin(heading)
    across = p[0, 0] * sin**2 - 2 * p[0, 1] * sin * cos + p[1, 1] * cos**2
    k = min(WIDEST_STD_M / np.sqrt(max(across, 1e-9)), 1.0) - 1
    shrunk = np.eye(6)
    shrunk[0, 0] += k * sin * sin
    shrunk[1, 1] += k * cos * cos
    shrunk[0, 1] = shrunk[1, 0] = -k * sin * cos
    shrunk[2, 2] = min(LANE_TURN_RAD / np.sqrt(max(p[2, 2], 1e-9)), 1.0)
    _spread(shrunk, p)


@njit(f"void({_STATE}, int64[::1], float64[::1])", cache=True)
def loosen(mean: Floats, covariance: Floats, tracks: Ints, std: Floats) -> None:
    """Adds to some states deviations along, across, of the speed (3,)."""
    for n in tracks:
        cos, sin = np.cos(mean[n, 2]), np.sin(mean[n, 2])
        along, across = std[0] ** 2, std[1] ** 2
        covariance[n, 0, 0] += along * cos * cos + across * sin * sin
        covariance[n, 1, 1] += along * sin * sin + across * cos * cos
        covariance[n, 0, 1] += (along - across) * cos * sin
        covariance[n, 1, 0] += (along - across) * cos * sin
        covariance[n, 3, 3] += std[2] ** 2


_GRAPH = "float64[:,::1], int64[::1], float64[::1], float64[::1], int64[::1], int64[::1]"


@njit(
    "void(float64[:,::1], float64[:,:,::1], float64[:,::1], int64[::1], float64[::1], float64[::1],"
    f" float64[::1], float64, boolean[::1], boolean[::1], {_GRAPH}, float64[::1])",
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
    dt_s: float,
    free: Bools,
    solid: Bools,
    segments: Floats,
    first: Ints,
    length_m: Floats,
    speed_mps: Floats,
    leads: Ints,
    followers: Ints,
    trips: Floats,
) -> None:
    """Moves the means of tracks that are not free along their lanes, behind those ahead of them.

    Solid ones stand in the way of those behind them; free ones do only that. `dims` (N, 4) are z,
    length, width, height.
    `share` (N,) is multiplied by the probability of the way taken at each fork, and becomes 0 where
    a lane ends on the map.
    """
    count = mean.shape[0]
    left_s = dt_s
    while left_s > 1e-9:
        step_s = min(STEP_S, left_s)
        left_s -= step_s
        gap_m, ahead_mps = _ahead(
            mean, dims, lane, along_m, solid, length_m, leads, followers, trips
        )
        for n in range(count):
            if lane[n] < 0:
                continue
            v = mean[n, 3]
            if not free[n]:
                v = _speed(v, speed_mps[lane[n]], gap_m[n], ahead_mps[n], step_s)
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
        if mean[n, 3] < STANDS_MPS:
            stands = np.eye(6)
            stands[3, 3] = min(STANDS_MPS / np.sqrt(max(covariance[n, 3, 3], 1e-9)), 1.0)
            _spread(stands, covariance[n])
