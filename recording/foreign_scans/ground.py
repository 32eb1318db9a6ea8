"""Ground model of imported scans, estimated from clouds and poses.

Each square metre of a scan has a vote, its lowest point. Planes are fitted to the votes around the
nodes of a grid, from the sensors outwards: each begins from those of its neighbours, so that walls
and cars do not raise it, and where votes are few it extrapolates its neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from perception.arrays import Bools
from perception.votes import lowest
from protocol.geometry import SE3, Floats
from recording.foreign_scans.alignment import ground_plane

NODE_M = 8.0
_AROUND_M = 12.0  # of a node: the votes that count for it
_NEAR_M, _FAR_M = 2.5, 60.0  # of a sensor: beyond its own vehicle; votes farther away are few
_SEEN_M = 25.0  # of a sensor: where the ground is seen so well that it can be judged
_SEED_M = 15.0
_STEEPEST_DEG = 20.0
_TOLERANCES_M = (0.5, 0.3)  # from the plane that is expected: votes that count, in turn
_FITS_M, _STANDS_M = 0.2, 0.5  # over or below the ground: it fits; above: something that stands
_PRIOR = 8.0  # votes: the weight of the neighbours' heights
_FITS_WELL = 0.7


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Planes (K, 3) at nodes (K, 2): height in m, rise along x and y; and what they rest on.

    `fit` is the share of the square metres around the sensors, but for what stands there, that lie
    within 0.2 m of it; `slope_deg` is the steepest there.
    """

    nodes: Floats
    planes: Floats
    fit: float
    slope_deg: float

    @classmethod
    def of(
        cls, scans: Iterable[tuple[Floats, SE3]], lines: Sequence[Floats], width_m: float
    ) -> Ground:
        """Fits the ground around lines.

        Args:
            scans: points (N, 3), sensor frame, and `map_SE3_sensor` of each.
            lines: x, y (K, 2) of each.
            width_m: of what is needed around the lines.
        """
        votes, sensors, seeds = [np.zeros((0, 3))], list[Floats](), list[Floats]()
        for points, map_SE3_sensor in scans:
            low = _votes(points @ map_SE3_sensor.rotation.T)
            plane = plane_below(low)
            votes.append(low + map_SE3_sensor.translation)
            sensors.append(map_SE3_sensor.translation)
            seeds.append(plane + np.array([map_SE3_sensor.translation[2], 0.0, 0.0]))
        every = np.concatenate(votes)
        nodes = _nodes(lines, width_m)
        planes = _grow(nodes, every[np.argsort(every[:, 0])], np.array(sensors), np.array(seeds))
        near = _away_m(every, np.array(sensors)) < _SEEN_M
        off_m = every[near, 2] - _height_m(nodes, planes, every[near, :2])
        seen = _away_m(nodes, np.array(sensors)) < _SEEN_M
        rise = np.hypot(*planes[seen, 1:].T).max(initial=0.0)
        fits = np.abs(off_m[off_m < _STANDS_M]) < _FITS_M
        share = float(fits.mean()) if len(fits) else 0.0
        return cls(nodes, planes, share, float(np.degrees(np.arctan(rise))))

    def height_m(self, xy: Floats) -> Floats:
        """Returns its height (N,) at places (N, 2)."""
        return _height_m(self.nodes, self.planes, xy)

    def __str__(self) -> str:
        """The message for the user."""
        message = (
            f"ground: slopes up to {self.slope_deg:.1f} degrees; {100 * self.fit:.0f} % of the "
            f"square metres within {_SEEN_M:g} m of a sensor lie within {_FITS_M:g} m of it"
        )
        if self.fit >= _FITS_WELL:
            return message
        return (
            f"{message}. It fits badly: detection needs the ground, so check heights, roll and "
            "pitch of the poses (m, rad or deg?), the mounts, and --height"
        )


def plane_below(upright: Floats) -> Floats:
    """Returns the ground's height below a sensor and its rise along x and y (3,).

    Of points (N, 3) along upright axes from the sensor; all 0 where it sees nothing below it.
    """
    votes = _votes(upright)
    away_m = np.hypot(votes[:, 0], votes[:, 1])
    near = votes[(away_m > _NEAR_M) & (away_m < _SEED_M) & (votes[:, 2] < 0)]
    normal, below_m, share = ground_plane(near)
    if share == 0:
        return np.zeros(3)
    plane = np.array([-below_m, -normal[0], -normal[1]]) / normal[2]
    if np.hypot(*plane[1:]) > np.tan(np.radians(_STEEPEST_DEG)):
        plane = np.array([np.quantile(near[:, 2], 0.2), 0.0, 0.0])
    return _fitted(near, plane)


def _votes(upright: Floats) -> Floats:
    """Returns the lowest point (V, 3) of each square metre, of points (N, 3) around a sensor."""
    away_m = np.hypot(upright[:, 0], upright[:, 1])
    near = upright[(away_m > _NEAR_M) & (away_m < _FAR_M)].astype(np.float32)
    return lowest(near, np.zeros(len(near), np.float32)).astype(np.float64)


def _nodes(lines: Sequence[Floats], width_m: float) -> Floats:
    """Returns the nodes (K, 2) of a grid within half the width of lines, and one farther."""
    reach = int(np.ceil(width_m / 2 / NODE_M)) + 1
    step = np.arange(-reach, reach + 1)
    around = np.stack(np.meshgrid(step, step), -1).reshape(-1, 2)
    around = around[np.hypot(*around.T) <= reach]
    places = np.concatenate([_dense(line) for line in lines])
    cells = np.unique(np.rint(places / NODE_M).astype(np.int64), axis=0)
    return np.unique((cells[:, None] + around).reshape(-1, 2), axis=0) * NODE_M


def _dense(line: Floats) -> Floats:
    """Returns points on a line (K, 2), no farther apart than nodes are."""
    parts = [line[:1]]
    for a, b in pairwise(line):
        pieces = int(np.hypot(*(b - a)) / NODE_M) + 1
        parts.append(a + (b - a) * (np.arange(1, pieces + 1) / pieces)[:, None])
    return np.concatenate(parts)


def _grow(nodes: Floats, votes: Floats, sensors: Floats, seeds: Floats) -> Floats:
    """Returns the planes (K, 3) at nodes, those near a sensor (S, 3) first.

    `votes` (V, 3) are sorted by x; `seeds` (S, 3) are the planes below the sensors.
    """
    planes = np.full((len(nodes), 3), np.nan)
    number = {(x, y): n for n, (x, y) in enumerate(np.rint(nodes / NODE_M).astype(int).tolist())}
    for n in np.argsort(_away_m(nodes, sensors), kind="stable"):
        column, row = np.rint(nodes[n] / NODE_M).astype(int).tolist()
        beside = [number.get((column + i, row + j), n) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        known = [m for m in beside if not np.isnan(planes[m, 0])]
        if known:
            expected = np.mean([_moved(planes[m], nodes[n] - nodes[m]) for m in known], axis=0)
        else:
            nearest = int(np.argmin(np.hypot(*(sensors[:, :2] - nodes[n]).T)))
            expected = _moved(seeds[nearest], nodes[n] - sensors[nearest, :2])
        first, end = np.searchsorted(votes[:, 0], nodes[n, 0] + np.array([-_AROUND_M, _AROUND_M]))
        near = votes[first:end] - [*nodes[n], 0.0]
        planes[n] = _fitted(near[np.hypot(near[:, 0], near[:, 1]) < _AROUND_M], expected)
    return planes


def _moved(plane: Floats, by_m: Floats) -> Floats:
    """Returns a plane (3,) as it is described from a place so far away (2,)."""
    return np.asarray(plane + np.array([plane[1:] @ by_m, 0.0, 0.0]))


def _fitted(votes: Floats, expected: Floats) -> Floats:
    """Returns the plane (3,) of votes (V, 3) near an expected one, which counts as a few."""
    prior = np.diag([_PRIOR, *(2 * [_PRIOR * (_AROUND_M / 2) ** 2])])
    plane, terms = expected, np.column_stack([np.ones(len(votes)), votes[:, :2]])
    for tolerance_m in _TOLERANCES_M:
        near: Bools = np.abs(votes[:, 2] - terms @ plane) < tolerance_m
        of = terms[near]
        plane = np.linalg.solve(of.T @ of + prior, of.T @ votes[near, 2] + prior @ expected)
    return np.asarray(plane)


_AT_ONCE = 2000  # places; bounds the memory


def _height_m(nodes: Floats, planes: Floats, xy: Floats) -> Floats:
    """Blends the planes around places (N, 2)."""
    found = np.zeros(len(xy))
    for first in range(0, len(xy), _AT_ONCE):
        places = xy[first : first + _AT_ONCE]
        x, y = (places[:, None, axis] - nodes[None, :, axis] for axis in range(2))
        square = x * x + y * y
        weight = np.maximum(1.0 - square / (1.5 * NODE_M) ** 2, 0.0) ** 2
        alone = np.flatnonzero(weight.sum(axis=1) == 0)
        weight[alone, square[alone].argmin(axis=1)] = 1.0
        at_m = planes[:, 0] + x * planes[:, 1] + y * planes[:, 2]
        found[first : first + _AT_ONCE] = (weight * at_m).sum(axis=1) / weight.sum(axis=1)
    return found


def _away_m(places: Floats, sensors: Floats) -> Floats:
    """Returns how far places (N, 2 or 3) are from the nearest of sensors (S, 3), in the plane."""
    nearest = np.full(len(places), np.inf)
    for sensor in sensors:
        away_m = np.hypot(places[:, 0] - sensor[0], places[:, 1] - sensor[1])
        np.minimum(nearest, away_m, out=nearest)
    return nearest
