"""How far a decoded scan lies from what was measured, both ways, and what was added to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from protocol.errors import CodecError
from protocol.scans import Floats, Floats32, RangeScan, ScanPattern

_AROUND = [(rows, columns) for rows in (-1, 0, 1) for columns in (-2, -1, 0, 1, 2)]

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ScanError:
    """The error of a decoded scan.

    Attributes:
        moved_m: the farthest that a measured point lies from its decoded self.
        added_m: the farthest that a decoded point which was not measured lies from the nearest
            point that was, or from one that is hardly farther; 0 if there is none.
        filled: how many points were not measured.
    """

    moved_m: float
    added_m: float
    filled: int

    @classmethod
    def of(cls, scan: RangeScan, decoded: Floats32) -> ScanError:
        """Measures decoded points (N, 3), of which each is known by the beam that it lies on.

        Raises:
            CodecError: a beam has two points, or a beam that returned has none.
        """
        beam = _beams(scan.pattern, decoded)
        hit = scan.range_m > 0
        times = np.bincount(beam, minlength=hit.size)
        if times.max(initial=0) > 1 or not times[hit.ravel()].all():
            raise CodecError("a decoded scan has not one point for each beam that returned")
        found = np.zeros((hit.size, 3))
        found[beam] = decoded
        measured = np.full((*hit.shape, 3), np.inf)
        measured[hit] = scan.cloud().points
        moved = np.linalg.norm(found.reshape(measured.shape)[hit] - measured[hit], axis=1)
        added = beam[~hit.ravel()[beam]]
        away = _away(measured, found, added)
        return cls(float(moved.max(initial=0)), float(away.max(initial=0)), len(added))

    @property
    def worst_m(self) -> float:
        """The larger of both."""
        return max(self.moved_m, self.added_m)


def _beams(pattern: ScanPattern, points: Floats32) -> Ints:
    """Returns the index of the beam that each point lies on."""
    x, y, z = points.astype(np.float64).T
    rise = np.linspace(pattern.upper_fov_deg, pattern.lower_fov_deg, pattern.channels)
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    edges = (rise[1:] + rise[:-1]) / 2
    row = pattern.channels - 1 - np.searchsorted(edges[::-1], elevation)
    turn = np.arctan2(y, x) / (2 * np.pi)
    column = np.round(turn * pattern.columns).astype(np.int64) % pattern.columns
    result: Ints = row * pattern.columns + column
    return result


def _away(measured: Floats, found: Floats, beams: Ints) -> Floats:
    """Returns how far each of these beams' points lies from the nearest measured one nearby.

    Args:
        measured: (channels, columns, 3), infinite where nothing came back.
        found: (beams, 3), decoded.
        beams: which of them are asked for.
    """
    channels, columns = measured.shape[:2]
    row, column = np.divmod(beams, columns)
    nearest = np.full(len(beams), np.inf)
    for down, aside in _AROUND:
        there = measured[np.clip(row + down, 0, channels - 1), (column + aside) % columns]
        np.minimum(nearest, np.linalg.norm(there - found[beams], axis=1), out=nearest)
    return nearest
