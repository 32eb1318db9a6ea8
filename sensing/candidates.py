"""Candidate rays by vehicle body: kernels that select the rays that Embree has to cast.

A body is a unit-sized mesh under an affine map. Its rays are moved into the mesh's own frame, where
one search tree serves all bodies of that mesh; a hit's parameter along the ray stays the same.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from perception.arrays import Floats32, Ints, Ints32
from protocol.geometry import Floats

_SLACK = 1e-4  # of the unit box: hits on its very faces count


@njit(
    "void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1], float64[::1], "
    "float64[:,:,::1])",
    cache=True,
)
def place(
    poses: Floats,
    sizes: Floats,
    bounds: Floats,
    rotation: Floats,
    translation: Floats,
    result: Floats,
) -> None:
    """Writes, for each body, its box's corners in the sensor frame and the map into its mesh.

    Args:
        poses: (N, 6) in the map frame.
        sizes: (N, 3) lengths, widths, heights.
        bounds: (N, 6) low and high corner of each body's mesh.
        rotation: (3, 3) of `map_SE3_sensor`.
        translation: (3,) of `map_SE3_sensor`.
        result: (N, 12, 3): eight corners, then the origin and the three columns of the map.
    """
    turned, shift = np.empty((3, 3)), np.empty(3)  # sensor_SE3_body
    for n in range(len(poses)):
        cr, sr = math.cos(poses[n, 3]), math.sin(poses[n, 3])
        cp, sp = math.cos(poses[n, 4]), math.sin(poses[n, 4])
        cy, sy = math.cos(poses[n, 5]), math.sin(poses[n, 5])
        for k in range(3):
            rx, ry, rz = rotation[0, k], rotation[1, k], rotation[2, k]
            turned[k, 0] = rx * cy * cp + ry * sy * cp - rz * sp
            turned[k, 1] = (
                rx * (cy * sp * sr - sy * cr) + ry * (sy * sp * sr + cy * cr) + rz * cp * sr
            )
            turned[k, 2] = (
                rx * (cy * sp * cr + sy * sr) + ry * (sy * sp * cr - cy * sr) + rz * cp * cr
            )
        for k in range(3):
            shift[k] = 0.0
            for axis in range(3):
                shift[k] += rotation[axis, k] * (poses[n, axis] - translation[axis])
            for corner in range(8):
                at = shift[k]
                for axis in range(3):
                    end = bounds[n, axis + 3 * ((corner >> axis) & 1)]
                    at += turned[k, axis] * sizes[n, axis] * end
                result[n, corner, k] = at
        for axis in range(3):
            start = 0.0
            for k in range(3):
                start -= turned[k, axis] * shift[k]
                result[n, 9 + k, axis] = turned[k, axis] / sizes[n, axis]
            result[n, 8, axis] = start / sizes[n, axis]


@njit("float64(float64[:,::1])", cache=True)
def _plan_distance(corners: Floats) -> float:
    """Returns how far the origin is from a box in plan: the nearest of its twelve edges' shadows.

    Right for an origin outside; inside, `windows` sees from the azimuths that the box is around.
    """
    nearest = 1e18
    for c in range(8):
        for axis in range(3):
            other = c | (1 << axis)
            if other == c:
                continue
            ax, ay = corners[c, 0], corners[c, 1]
            ux, uy = corners[other, 0] - ax, corners[other, 1] - ay
            length2 = ux * ux + uy * uy
            t = 0.0
            if length2 > 0.0:
                t = min(1.0, max(0.0, -(ax * ux + ay * uy) / length2))
            dx, dy = ax + t * ux, ay + t * uy
            nearest = min(nearest, dx * dx + dy * dy)
    return math.sqrt(nearest)


@njit("void(float64[:,:,::1], float64[::1], int64, float64, int64[:,::1])", cache=True)
def windows(
    placed: Floats, elevations_rad: Floats, columns: int, range_m: float, result: Ints
) -> None:
    """Writes the part of the pattern (N, 4) that holds each body's box.

    The rings' elevations go down.

    First row, end row, first column (may be negative: columns wrap), number of columns. The number
    is 0 for a body out of range.
    """
    azimuth = np.empty(8)
    channels, below_rad = len(elevations_rad), -elevations_rad
    for n in range(len(placed)):
        result[n] = 0
        low_z, high_z, far = 1e9, -1e9, 0.0
        for c in range(8):
            x, y, z = placed[n, c, 0], placed[n, c, 1], placed[n, c, 2]
            low_z, high_z = min(low_z, z), max(high_z, z)
            far = max(far, math.sqrt(x * x + y * y))
            azimuth[c] = math.atan2(y, x)
        near = _plan_distance(placed[n])
        if near > range_m:
            continue
        least, most = 0.0, 0.0
        for c in range(8):
            turn = azimuth[c] - azimuth[0]
            turn -= 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5)
            least, most = min(least, turn), max(most, turn)
        if most - least >= math.pi or near < 1e-3:  # the box is around the sensor
            result[n, 1], result[n, 3] = channels, columns
            continue
        top = math.atan2(high_z, near if high_z > 0 else far)
        bottom = math.atan2(low_z, near if low_z < 0 else far)
        first = max(0, int(np.searchsorted(below_rad, -top)) - 1)  # a ring more for rounding
        end = min(channels, int(np.searchsorted(below_rad, -bottom)) + 1)
        if first >= end:
            continue
        per_rad = columns / (2 * math.pi)
        start = math.floor((azimuth[0] + least) * per_rad)
        stop = math.ceil((azimuth[0] + most) * per_rad) + 1
        result[n, 0], result[n, 1], result[n, 2] = first, end, start
        result[n, 3] = min(stop - start, columns)


@njit(
    "int64(Array(float32, 3, 'C', readonly=True), float32[:,::1], float64[:,:,::1], "
    "float64[:,::1], int64[:,::1], int64[::1], float32[:,::1], float32[:,::1], float32[::1], "
    "int32[::1], int32[::1])",
    cache=True,
)
def gather(  # noqa: PLR0913, PLR0917 - compiled code takes its arrays one by one
    pattern: Floats32,
    range_m: Floats32,
    placed: Floats,
    bounds: Floats,
    parts: Ints,
    members: Ints,
    origins: Floats32,
    directions: Floats32,
    limits: Floats32,
    beams: Ints32,
    owners: Ints32,
) -> int:
    """Writes the rays that pass through the members' boxes, in their mesh's frame.

    A ray's limit is the range known so far, its owner the body. Returns how many were written.
    """
    columns = pattern.shape[1]
    count = 0
    low, high = np.empty(3), np.empty(3)
    a = np.empty((4, 3))
    for n in members:
        for axis in range(3):
            low[axis] = bounds[n, axis] - _SLACK
            high[axis] = bounds[n, axis + 3] + _SLACK
            for k in range(4):
                a[k, axis] = placed[n, 8 + k, axis]
        for row in range(parts[n, 0], parts[n, 1]):
            for turn in range(parts[n, 2], parts[n, 2] + parts[n, 3]):
                column = turn % columns
                dx, dy, dz = pattern[row, column]
                enter, leave = 0.0, float(range_m[row, column])
                for axis in range(3):
                    step = a[1, axis] * dx + a[2, axis] * dy + a[3, axis] * dz
                    directions[axis, count] = step
                    if step == 0.0:
                        step = 1e-30
                    one = (low[axis] - a[0, axis]) / step
                    other = (high[axis] - a[0, axis]) / step
                    enter = max(enter, min(one, other))
                    leave = min(leave, max(one, other))
                if enter <= leave:
                    for axis in range(3):
                        origins[axis, count] = a[0, axis]
                    limits[count] = range_m[row, column]
                    beams[count] = row * columns + column
                    owners[count] = n
                    count += 1
    return count


@njit("void(float32[::1], int32[::1], int32[::1], int32[::1], float32[::1])", cache=True)
def keep_nearest(
    range_m: Floats32, hit: Ints32, beams: Ints32, owners: Ints32, found_m: Floats32
) -> None:
    """Lowers the range of each beam to what was found on it, and notes the body that is hit."""
    for k in range(len(beams)):
        if found_m[k] < range_m[beams[k]]:
            range_m[beams[k]] = found_m[k]
            hit[beams[k]] = owners[k]


@njit("void(float32[:,::1], float32[:,::1], float32[:,::1])", cache=True)
def turn(directions: Floats32, rotation: Floats32, result: Floats32) -> None:
    """Turns directions (3, N), alike on every machine."""
    for axis in range(3):
        a, b, c = rotation[axis]
        for n in range(directions.shape[1]):
            result[axis, n] = a * directions[0, n] + b * directions[1, n] + c * directions[2, n]
