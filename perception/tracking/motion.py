"""Motion of tracks in the open, and how detections correct it: an extended Kalman filter.

A state is x, y, heading, speed along it, yaw rate and acceleration, with a covariance (6, 6), of a
constant turn rate and acceleration (Schubert et al. 2008), where the acceleration fades (Singer
1970). On lanes `lane_following` moves those that no sensor sees.

Measured is the end of a vehicle that was seen, or else the one that is turned to the nearest
sensor, with a one-sided error: where a bonnet lies between two beams, or is hidden, the box begins
farther away, never nearer. So an end that is too far away weighs the less, the farther it is (Geman
and McClure 1987).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Ints
from perception.detector import LIDAR, Vehicles
from perception.tracking.sightlines import SightLines

BOX_STD = np.array([0.35, 0.2, 0.08])  # of a box near a sensor: along, across, heading
SLENDER_M, SLENDER_YAW_STD = 1.1, 0.25  # the box of what is so narrow may be turned anyhow
FAR_STD, FAR_M = 0.015, 40.0  # along, more for each metre beyond: only an end is seen
NEAR_STD, NEAR_M = 1.5, 6.0  # along, nearer to a sensor, which sees over a part of the vehicle
POSE_STD = np.array([0.1, 0.1, 0.02])  # of an agent's own pose, beside the deviation that it states
SIDE_STD_M = np.array([1.5, 0.4])  # along, across: of a jump as another side comes into view
CHANGE_STD_M = np.array([0.4, 1.3])  # of a change of lane, which is 3.5 m wide
CHANGE_STD_MPS = 1.5  # along, as the time from frame to frame allows
JUMP_STD_OFF_MAP_M = np.array([(0.5, 0.5)])
JUMPED_STD = np.array([0.3, 1.3, 0.0])  # of what has jumped: a change of lane, or another side seen
TURN_LIFE_S = 1.0  # of a yaw rate: curves end
ACCEL_LIFE_S = 4.0  # of an acceleration
STEADY_ACCEL_STD_MPS2 = 1.5  # of an unknown one
ROUGH = 0.02  # share of an acceleration's variance that changes at once
ABEAM_M = 1.0  # beyond a box's end: a sensor that is not so far ahead or behind sees its side
END_STD_M, END_STD_PER_M2 = 0.15, 4e-5  # of the measured end, and by its range squared
CROSSWISE_RAD = 0.9  # a box that is turned by more is of two vehicles abreast ...
CROSSWISE_M = 3.0  # ... if it is so long ...
SURE_YAW_STD = 0.15  # ... and the track's heading is known so well
VAGUE_STD_M = 2.0  # of a box that says little of where its vehicle is
STANDS_MPS = 0.5  # whoever seems to drive backwards so slowly stands
BACKWARDS_MPS = 2.0  # nobody drives backwards faster: the heading is the reverse
AWAY, TOWARDS = 2.5, 3.0  # deviations: an end farther off weighs less


def jumps(dt_s: float, *, on_map: bool) -> Floats:
    """Returns deviations along and across (K, 2) of each kind of jump between two frames."""
    if not on_map:
        return JUMP_STD_OFF_MAP_M
    along_m = np.clip(CHANGE_STD_MPS * dt_s, CHANGE_STD_M[0], SIDE_STD_M[0])
    return np.array([SIDE_STD_M, (along_m, CHANGE_STD_M[1])])


def deviations(observed: Vehicles, visible: SightLines | None) -> tuple[Floats, Floats]:
    """Returns the standard deviations of detections, and from where they were seen.

    The first are deviations along, across and in heading (N, 3), the second (N, 3) how far ahead of
    a box's middle the nearest sensor stands, how far away it is, and 1 for an agent's own pose.
    """
    is_pose = np.array([source != LIDAR for source in observed.sources], np.bool_)
    std, seen = np.empty((len(observed), 3)), np.zeros((len(observed), 3))
    sensors = visible.sensors if visible is not None else np.zeros((0, 3))
    _deviate(observed.boxes, observed.position_std_m, is_pose, sensors, std, seen)
    return std, seen


@njit(
    "void(float64[:,:], float64[:], boolean[::1], float64[:,:], float64[:,::1], float64[:,::1])",
    cache=True,
)
def _deviate(
    boxes: Floats,
    position_std_m: Floats,
    is_pose: Bools,
    sensors: Floats,
    std: Floats,
    seen: Floats,
) -> None:
    """Fills `std` and `seen` (N, 3), see `deviations`; `seen` is zero before."""
    for n in range(boxes.shape[0]):
        std[n] = POSE_STD if is_pose[n] else BOX_STD
        if boxes[n, 4] < SLENDER_M and not is_pose[n]:
            std[n, 2] = SLENDER_YAW_STD
        seen[n, 2] = is_pose[n]
        range_m, ahead_m = np.inf, 0.0
        for sensor in range(sensors.shape[0]):
            x, y = sensors[sensor, 0] - boxes[n, 0], sensors[sensor, 1] - boxes[n, 1]
            if np.sqrt(x * x + y * y) < range_m:
                range_m = np.sqrt(x * x + y * y)
                ahead_m = np.cos(boxes[n, 6]) * x + np.sin(boxes[n, 6]) * y
        if range_m < np.inf:
            seen[n, 1] = range_m
            if not is_pose[n]:
                seen[n, 0] = ahead_m
                std[n, 0] += FAR_STD * max(range_m - FAR_M, 0.0)
                if range_m < NEAR_M:
                    std[n, 0] = NEAR_STD
        for axis in range(2):
            std[n, axis] = np.hypot(std[n, axis], position_std_m[n])


_STATE = "float64[:,::1], float64[:,:,::1]"


@njit("void(float64[:,:], float64[:,:])", cache=True)
def spread(f: Floats, p: Floats) -> None:
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
    """Kalman update of a state by a scalar innovation along an axis (6,)."""
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


@njit(f"void({_STATE}, float64, float64[::1], float64, boolean[::1], boolean[::1])", cache=True)
def predict(
    mean: Floats,
    covariance: Floats,
    dt_s: float,
    accel_mps2: Floats,
    turn_rps: float,
    free: Bools,
    steady: Bools,
) -> None:
    """Moves states (N, 6) and their covariances (N, 6, 6) on; means only of those that are free.

    Of those that are `steady`, the deviation `accel_mps2` (N,) is that of the speed after 1 s; of
    others it is that of the acceleration.
    """
    f = np.eye(6)
    fade = np.exp(-dt_s / ACCEL_LIFE_S)
    for n in range(mean.shape[0]):
        yaw, v, w, a = mean[n, 2], mean[n, 3], mean[n, 4], mean[n, 5]
        if steady[n] or not free[n]:
            a = 0.0
        if a < 0.0 and v > -STANDS_MPS and v + a * dt_s < 0.0:  # nobody brakes to drive backwards
            a = -max(v, 0.0) / dt_s
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
        spread(f, p)
        q = accel_mps2[n] ** 2 if steady[n] else ROUGH * accel_mps2[n] ** 2
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
            p[5, 5] = STEADY_ACCEL_STD_MPS2**2
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


@njit("float64(float64, float64, float64, float64[:,:], float64[::1])", cache=True)
def _of_end(towards_m: float, off_m: float, range_m: float, p: Floats, axis: Floats) -> float:
    """Returns the deviation of an end that is off by so much, `towards_m` the sensor or away.

    So is the middle of a box whose side a sensor sees. Where the sensor of a box is unknown, its
    own deviation along holds.
    """
    deviation = END_STD_M + END_STD_PER_M2 * range_m**2
    total = deviation**2
    for i in range(2):
        for j in range(2):
            total += axis[i] * p[i, j] * axis[j]
    far = off_m / np.sqrt(total)
    if towards_m < 0.0:
        return float(deviation * (1.0 + (far / AWAY) ** 2))
    return float(deviation * np.sqrt(max(far / TOWARDS, 1.0)))


@njit("UniTuple(float64, 2)(float64, float64, float64, float64[::1])", cache=True)
def _middle(long_m: float, length_m: float, ahead_m: float, ends_m: Floats) -> tuple[float, float]:
    """Returns which end of a box is known, and where its vehicle's middle is, from the box's.

    The end is 1 for the front, -1 for the rear, 0 for both or neither. Where none was seen, it is
    the one that is turned to the nearest sensor, which is so far ahead.
    """
    rear_m, front_m = ends_m
    if not np.isnan(rear_m) and not np.isnan(front_m):
        return 0.0, (rear_m + front_m) / 2
    if not np.isnan(front_m):
        return 1.0, front_m - length_m / 2
    if not np.isnan(rear_m):
        return -1.0, rear_m + length_m / 2
    if abs(ahead_m) <= long_m / 2 + ABEAM_M:
        return 0.0, 0.0
    side = np.sign(ahead_m)
    return side, side * (long_m - length_m) / 2


@njit("float64(float64)", cache=True)
def _half_turn(angle: float) -> float:
    """Returns the angle between headings that may be reversed, modulo a half turn."""
    return float((angle + np.pi / 2) % np.pi - np.pi / 2)


@njit("boolean(float64, float64, float64, float64)", cache=True)
def _is_crosswise(turned: float, variance: float, length_m: float, is_pose: float) -> bool:
    """Whether a box that is `turned` lies across its track, whose heading is known."""
    is_sure = variance < SURE_YAW_STD**2
    return bool(
        is_sure and is_pose == 0.0 and length_m > CROSSWISE_M and abs(turned) > CROSSWISE_RAD
    )


def known_ends(long_m: Floats, seen: Floats, ends_m: Floats) -> Floats:
    """Returns by which end of boxes (N,) a vehicle's place was known: 1 front, -1 rear, 0 neither.

    That is the one that was seen, or of both, or if neither was, the one turned to the sensor.
    """
    turned_to = np.where(np.abs(seen[:, 0]) > long_m / 2 + ABEAM_M, np.sign(seen[:, 0]), 0.0)
    has_rear, has_front = ~np.isnan(ends_m).T
    known = np.where(has_rear == has_front, turned_to, np.where(has_front, 1.0, -1.0))
    return np.asarray(known * (seen[:, 2] == 0.0))


@njit(
    "boolean[::1](float64[:,::1], float64[:,:,::1], int64[::1], float64[:,::1], float64[:,::1])",
    cache=True,
)
def abreast(mean: Floats, covariance: Floats, tracks: Ints, boxes: Floats, seen: Floats) -> Bools:
    """Returns which boxes (M,) are of two vehicles abreast: they say nothing of a size."""
    result = np.zeros(tracks.shape[0], np.bool_)
    for m in range(tracks.shape[0]):
        n = tracks[m]
        turned = _half_turn(boxes[m, 6] - mean[n, 2])
        result[m] = _is_crosswise(turned, covariance[n, 2, 2], boxes[m, 3], seen[m, 2])
    return result


@njit(
    f"void({_STATE}, float64[::1], boolean[::1], int64[::1], float64[:,::1],"
    " float64[:,::1], float64[:,::1], float64[:,::1], boolean[::1])",
    cache=True,
)
def correct(
    mean: Floats,
    covariance: Floats,
    length_m: Floats,
    on_lane: Bools,
    tracks: Ints,
    boxes: Floats,
    std: Floats,
    seen: Floats,
    ends_m: Floats,
    vague: Bools,
) -> None:
    """Corrects some states by boxes (M, 7) of deviations along, across and in heading (M, 3).

    A box's heading may be reversed. A track that keeps going backwards has a reversed heading
    itself; one that is `on_lane` (N,), where the road tells it, only if its box is turned the other
    way too. `seen` (M, 3) is as of `deviations`, `ends_m` (M, 2) as of `Vehicles`. Along, what
    counts is an end, as of a vehicle of `length_m` (N,): see `_middle`. `vague` boxes (M,), such as
    those of two vehicles abreast, correct little.
    """
    axes = np.zeros((3, 6))
    axes[2, 2] = 1.0
    for m in range(tracks.shape[0]):
        n = tracks[m]
        p = covariance[n]
        cos, sin = np.cos(boxes[m, 6]), np.sin(boxes[m, 6])
        axes[0, 0], axes[0, 1], axes[1, 0], axes[1, 1] = cos, sin, -sin, cos
        if vague[m]:
            x, y = boxes[m, 0] - mean[n, 0], boxes[m, 1] - mean[n, 1]
            _correct_by(mean[n], p, axes[0], cos * x + sin * y, VAGUE_STD_M**2)
            _correct_by(mean[n], p, axes[1], cos * y - sin * x, VAGUE_STD_M**2)
            continue
        for axis in range(2):
            x, y = boxes[m, 0] - mean[n, 0], boxes[m, 1] - mean[n, 1]
            off, deviation = axes[axis, 0] * x + axes[axis, 1] * y, std[m, axis]
            if axis == 0 and seen[m, 2] == 0.0:
                side, middle_m = _middle(boxes[m, 3], length_m[n], seen[m, 0], ends_m[m])
                off += middle_m
                if seen[m, 1] > 0.0:
                    deviation = _of_end(side * off, abs(off), seen[m, 1], p, axes[0])
            _correct_by(mean[n], p, axes[axis], off, deviation**2)
        turned = _half_turn(boxes[m, 6] - mean[n, 2])
        _correct_by(mean[n], p, axes[2], turned, std[m, 2] ** 2)
        if on_lane[n] and np.cos(boxes[m, 6] - mean[n, 2]) >= 0.0:
            mean[n, 3] = max(mean[n, 3], -BACKWARDS_MPS)
        elif mean[n, 3] < -BACKWARDS_MPS:
            mean[n, 2] += np.pi
            mean[n, 3] = -mean[n, 3]
            mean[n, 5] = -mean[n, 5]
            for i in (3, 5):
                p[i, :] *= -1
                p[:, i] *= -1
        mean[n, 2] = (mean[n, 2] + np.pi) % (2 * np.pi) - np.pi


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
