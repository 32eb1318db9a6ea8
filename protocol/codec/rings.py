"""The rings of a spinning LiDAR, found in an unordered cloud.

Such a cloud came from lasers of fixed elevation that fire at equal steps of azimuth, and files keep
the points exactly enough to find both again. Points that fit a beam within part of the bound become
a range image; the few that do not go into an octree.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.codec.beam_origin import FRAME_ORIGIN, BeamOrigin, find_origin
from protocol.codec.prediction import MIN_FLAT
from protocol.codec.rans import I4, I8
from protocol.errors import CodecError
from protocol.limits import MAX_BEAMS, MAX_CELL_EDGE_M, MAX_POINTS
from protocol.scans import Floats, Floats32

_NEAREST_M = 1e-3
_BIN_RAD = 2.5e-4  # of elevation; rings lie at least eight of these apart
_REACH = 3  # bins to either side that belong to a ring
_BINS = int(np.pi / _BIN_RAD) + 2
_AZIMUTHS = 1 << 16
_PERIOD = 4096
_WAVE = np.cos((np.arange(_PERIOD) + 0.5) * (2 * np.pi / _PERIOD))


@njit(
    "void(float64[:,::1], float64[::1], float64[::1], int64[::1])",
    cache=True,
    nogil=True,
)
def measure_angles(points: Floats, elevation: Floats, azimuth: Floats, bins: I8) -> None:
    """Fills elevation and azimuth of each point (N, 3), and the bin of its elevation."""
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        elevation[n] = np.arctan2(z, np.sqrt(x * x + y * y))
        azimuth[n] = np.arctan2(y, x)
        bins[n] = int((elevation[n] + np.pi / 2) / _BIN_RAD) + _REACH


@njit(
    "void(float64[:,::1], float64[::1], int64[::1], float64[::1], float64[::1], float64[::1])",
    cache=True,
    nogil=True,
)
def weigh_rings(
    points: Floats, elevation: Floats, ring: I8, rough: Floats, total: Floats, away: Floats
) -> None:
    """Adds up, by ring, how far points are above its `rough` elevation, the far ones counting most.

    Args:
        points: (N, 3).
        elevation: of each point.
        ring: of each point.
        rough: elevation of each ring.
        total: zeros, filled with each ring's weights.
        away: zeros, filled with each ring's weighted sum.
    """
    for n in range(len(points)):
        at = ring[n]
        above = elevation[n] - rough[at]
        if abs(above) <= (_REACH + 0.5) * _BIN_RAD:
            weight = points[n, 0] ** 2 + points[n, 1] ** 2
            total[at] += weight
            away[at] += weight * above


@njit(
    "void(float64[::1], int64[::1], float64, float64[::1], float64[::1])",
    cache=True,
    nogil=True,
)
def turn_phases(azimuth: Floats, ring: I8, columns: float, cos: Floats, sin: Floats) -> None:
    """Adds up, by ring, the cosines and sines of where in a column's width its points lie."""
    for n in range(len(azimuth)):
        turn = int(np.floor(azimuth[n] * (columns * (_PERIOD / (2 * np.pi)))))
        cos[ring[n]] += _WAVE[turn % _PERIOD]
        sin[ring[n]] += _WAVE[(turn - _PERIOD // 4) % _PERIOD]


@njit(
    "void(float64[:,::1], float64[::1], float64[:,::1], float64[:,::1], int64[::1], int64[::1], "
    "float64[::1], float64[::1])",
    cache=True,
    nogil=True,
)
def measure_beams(
    points: Floats,
    azimuth: Floats,
    turns: Floats,
    azimuths: Floats,
    ring: I8,
    beam: I8,
    range_m: Floats,
    beside_m: Floats,
) -> None:
    """Fills the beam of each point (N, 3), how far along that and how far beside it the point lies.

    Args:
        points: in the sensor frame, their heights those over the origin of the beams.
        azimuth: of each point.
        turns: of each ring, as `Rings.spin`, where in a column's width it fires, and how far along
            its direction its beams begin (rings, 5).
        azimuths: of each column, as `Rings.spin`.
        ring: of each point.
        beam: filled with ring times columns plus column.
        range_m: filled.
        beside_m: filled.
    """
    columns = len(azimuths)
    for n in range(len(points)):
        place = azimuth[n] * (columns / (2 * np.pi)) - turns[ring[n], 3]
        column = int(np.rint(place)) % columns
        beam[n] = ring[n] * columns + column
        out, side = turns[ring[n], 0], turns[ring[n], 1]
        a, b = azimuths[column, 0], azimuths[column, 1]
        # What the decoder multiplies is float32, and so is what the image holds.
        along_x, along_y = np.float32(out * a - side * b), np.float32(side * a + out * b)
        along_z = np.float32(turns[ring[n], 2])
        lead = turns[ring[n], 4]
        x, y = points[n, 0] - along_x * lead, points[n, 1] - along_y * lead
        z = points[n, 2]
        metres = np.float64(np.float32(x * along_x + y * along_y + z * along_z))
        range_m[n] = metres
        x, y, z = x - along_x * metres, y - along_y * metres, z - along_z * metres
        beside_m[n] = np.sqrt(x * x + y * y + z * z)


@njit(
    "int64(int64[::1], float64[::1], float64[::1], float64, float32[::1], int32[::1], int64[::1])",
    cache=True,
    nogil=True,
)
def assign_beams(
    beam: I8,
    range_m: Floats,
    beside_m: Floats,
    reach_m: float,
    image: Floats32,
    owner: I4,
    misfits: I8,
) -> int:
    """Assigns each beam the first point within reach; returns the number of points without a beam.

    Args:
        beam: of each point (N,).
        range_m: of each point.
        beside_m: of each point.
        reach_m: how far beside its beam a point may lie.
        image: zeros (beams,), filled with ranges.
        owner: -1 (beams,), filled with indices of points.
        misfits: (N,), filled with the indices of points without a beam.
    """
    count = 0
    for n in range(len(beam)):
        at = beam[n]
        if beside_m[n] <= reach_m and range_m[n] > _NEAREST_M and owner[at] < 0:
            owner[at] = n
            image[at] = range_m[n]
        else:
            misfits[count] = n
            count += 1
    return count


Ints = npt.NDArray[np.int64]

MAX_RINGS = 512
_HEAD = struct.Struct("<Idff")
_MIN_POINTS = 256
_MISFITS = 0.2  # more than this share: not the cloud of one spinning LiDAR
_FULL_RINGS = 8  # those with the most points determine the columns
_SAMPLE = 4096  # of points
_USUAL = 0.99  # of the points decide how far beside its beam a point may lie
_BEAM_SHARE = (0.1, 0.6)  # of the bound, at least and at most
_SURE_MISFITS, _SURE_FILLED = 0.01, 0.25
_SURE_BESIDE = 0.15  # of the bound
_SURE_SHARING, _SURE_RINGS = 0.55, 1.1  # points in a square of the bound's width, rings across it
_FINE_ROOM_M, _FINE_SHARING = 0.12, 1.0
_SECTORS, _SAMPLE_SHARE, _LEAST_SAMPLE = 8, 1 / 8, 1024  # of a sample: its share, its points


@dataclass(frozen=True, slots=True, eq=False)
class Rings:
    """Elevations and azimuths of the first column (channels,), as they are sent, uppermost first.

    Elevations are float32 in rad, azimuths u16, in 1/65536 of a column's width.
    """

    elevations: Floats32
    azimuths: npt.NDArray[np.uint16]
    columns: int
    origin: BeamOrigin = FRAME_ORIGIN

    @property
    def spin(self) -> tuple[Floats, Floats]:
        """What the directions are products of, as `ScanPattern.spin`."""
        elevations = self.elevations.astype(np.float64)
        offsets = self.azimuths * (2 * np.pi / self.columns / _AZIMUTHS)
        azimuths = np.arange(self.columns) * (2 * np.pi / self.columns)
        flat = np.cos(elevations)
        turns = [flat * np.cos(offsets), flat * np.sin(offsets), np.sin(elevations)]
        return np.stack(turns, -1), np.stack([np.cos(azimuths), np.sin(azimuths)], -1)

    def to_bytes(self, misfits: int, edge_m: float) -> bytes:
        """Returns the section, with the number of points elsewhere and the edge of their cells."""
        angles = self.elevations.astype("<f4").tobytes() + self.azimuths.astype("<u2").tobytes()
        origin = self.origin
        return _HEAD.pack(misfits, edge_m, origin.height_m, origin.radius_m) + angles

    @classmethod
    def from_bytes(cls, section: bytes, channels: int, columns: int) -> tuple[Self, int, float]:
        """Reverses `to_bytes`.

        Raises:
            CodecError: the section does not hold this many rings.
        """
        if len(section) != _HEAD.size + 6 * channels:
            raise CodecError(f"{len(section)} bytes of rings for {channels} channels")
        misfits, edge_m, *of_origin = _HEAD.unpack_from(section)
        origin = BeamOrigin(*of_origin)
        elevations = np.frombuffer(section, "<f4", channels, _HEAD.size)
        azimuths = np.frombuffer(section, "<u2", channels, _HEAD.size + 4 * channels)
        if not (
            np.isfinite(elevations).all() and 0 < edge_m < MAX_CELL_EDGE_M and misfits <= MAX_POINTS
        ):
            raise CodecError(
                f"rings that are not finite, or {misfits} points in cells of {edge_m} m"
            )
        if not origin.is_allowed:
            raise CodecError(f"beams that begin {origin.height_m} m up, {origin.radius_m} m out")
        return cls(elevations, azimuths, columns, origin), misfits, edge_m


@dataclass(frozen=True, slots=True, eq=False)
class RingImage:
    """A cloud as a range image (channels, columns), and the points that have no place in it.

    `beside_m` is the farthest that a point may lie beside its beam; `order` holds the indices of
    the placed points ring by ring, `misfits` those of the others.
    """

    rings: Rings
    range_m: Floats32
    beside_m: float
    order: Ints
    misfits: Ints

    def is_sure(self, room_m: float) -> bool:
        """Whether the image certainly takes fewer bytes than an octree: no sample is needed.

        It does where next to all points fit, hardly beside their beams, the beams between them are
        few, and hardly two points lie in the width of the bound.
        """
        filled = len(self.order) / self.range_m.size
        few = len(self.misfits) <= _SURE_MISFITS * len(self.order)
        well = self.beside_m <= _SURE_BESIDE * room_m
        along, across = self._crowding(room_m)
        alone = filled * along * across <= _SURE_SHARING and across <= _SURE_RINGS
        return few and well and alone and filled >= _SURE_FILLED and room_m <= _FINE_ROOM_M

    def is_fine(self, room_m: float) -> bool:
        """Whether points mostly have places of their own in an octree.

        Indoors, at a coarse bound, many share one, which costs an octree next to nothing.
        """
        along, across = self._crowding(room_m)
        filled = len(self.order) / self.range_m.size
        return room_m <= _FINE_ROOM_M and filled * along * across <= _FINE_SHARING

    def _crowding(self, room_m: float) -> tuple[float, float]:
        """Returns how many columns and how many rings lie within the bound, at a long range.

        The range is the upper quartile: what lies nearer than the rest is the road, mostly.
        """
        range_m = self.range_m.reshape(-1)[:: max(1, self.range_m.size // _SAMPLE)]
        range_m = range_m[range_m > 0]
        if not len(range_m) or len(self.rings.elevations) < 2:
            return 0.0, 0.0
        within_rad = room_m / float(np.quantile(range_m, 0.75))
        gap_rad = float(np.median(np.diff(np.sort(self.rings.elevations))))
        return within_rad * self.rings.columns / (2 * np.pi), within_rad / max(gap_rad, 1e-9)

    def sectors(self, points: Floats) -> RingImage:
        """Returns what lies in narrow sectors to all sides, a sample of the cloud (N, 3)."""
        seen = np.flatnonzero(self.range_m.any(axis=0))
        share = max(_SAMPLE_SHARE, _LEAST_SAMPLE / len(points))
        rank = np.arange(len(seen)) * _SECTORS % len(seen)
        kept = np.zeros(self.rings.columns, np.bool_)
        kept[seen[rank < share * len(seen)]] = True
        owner = np.full(self.range_m.shape, -1, np.int64)
        owner[self.range_m > 0] = self.order
        order = owner[:, kept]
        away = points[self.misfits]
        turn = np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi)
        column = np.floor(turn * self.rings.columns).astype(np.int64) % self.rings.columns
        image = np.ascontiguousarray(self.range_m[:, kept])
        misfits = self.misfits[kept[column]]
        return RingImage(self.rings, image, self.beside_m, order[order >= 0], misfits)


def find_rings(points: Floats, room_m: float) -> RingImage | None:
    """Returns the cloud (N, 3) as an image, or None if it is not that of one spinning LiDAR.

    Args:
        points: in the sensor frame.
        room_m: how far a point may come to lie from where it was.
    """
    if len(points) < _MIN_POINTS:
        return None
    points = np.ascontiguousarray(points)
    origin = find_origin(points)
    seen = points if origin == FRAME_ORIGIN else origin.seen_from(points)
    elevation, azimuth = np.empty(len(points)), np.empty(len(points))
    bins = np.empty(len(points), np.int64)
    measure_angles(seen, elevation, azimuth, bins)
    rough = _peaks(bins)
    if not 1 <= len(rough) <= MAX_RINGS:
        return None
    ring = _nearest(rough)[bins]
    middles = _middles(rough, seen, ring, elevation)
    columns = _columns(ring, azimuth)
    if columns < 8 or columns * len(middles) > MAX_BEAMS:
        return None
    phases = _phases(ring, azimuth, columns, len(middles))
    rings = Rings(middles.astype(np.float32), phases, columns, origin)
    return _image(points, azimuth, rings, ring, room_m)


def _peaks(bins: Ints) -> Ints:
    """Returns the fullest bins of elevation, those of the rings, uppermost first."""
    size = _BINS + 2 * _REACH
    counts = np.bincount(bins, minlength=size)
    ends = np.concatenate([[0], np.cumsum(counts)])
    around = ends[2 * _REACH + 1 :] - ends[: -2 * _REACH - 1]
    inner = counts[_REACH : size - _REACH]
    peak = around >= max(4, len(bins) // 20_000)
    peak &= inner > 0
    for offset in range(1, _REACH + 1):
        # The first of equals, so that two bins of one height make one ring.
        peak &= inner > counts[_REACH - offset : size - _REACH - offset]
        peak &= inner >= counts[_REACH + offset : size - _REACH + offset]
    return np.flatnonzero(peak)[::-1] + _REACH


def _nearest(peaks: Ints) -> Ints:
    """Returns the index of the nearest peak for each bin."""
    rising = peaks[::-1]
    borders = (rising[1:] + rising[:-1]) // 2 + 1
    result: Ints = len(peaks) - 1 - np.searchsorted(borders, np.arange(_BINS + 2 * _REACH), "right")
    return result


def _middles(peaks: Ints, points: Floats, ring: Ints, elevation: Floats) -> Floats:
    """Returns the elevations of rings: means over the points nearby, the far ones counting most."""
    rough = (peaks - _REACH + 0.5) * _BIN_RAD - np.pi / 2
    total, away = np.zeros(len(peaks)), np.zeros(len(peaks))
    weigh_rings(points, elevation, ring, rough, total, away)
    result: Floats = rough + away / np.maximum(total, 1e-9)
    return result


def _columns(ring: Ints, azimuth: Floats) -> int:
    """Returns how many columns one revolution has, from the gaps between neighbours."""
    full = np.argsort(np.bincount(ring), kind="stable")[-_FULL_RINGS:]
    chosen = np.isin(np.arange(ring.max() + 1), full)[ring]
    gaps = np.diff(np.sort(ring[chosen] * 8.0 + azimuth[chosen]))
    gaps = gaps[(gaps > 1e-5) & (gaps < 0.5)]
    if not len(gaps):
        return 0
    usual = float(np.quantile(gaps, 0.3))
    single = gaps[np.abs(gaps - usual) < 0.2 * usual]
    return round(2 * np.pi / float(single.mean()))


def _phases(ring: Ints, azimuth: Floats, columns: int, channels: int) -> npt.NDArray[np.uint16]:
    """Returns where in a column's width each ring fires, in 1/65536."""
    cos, sin = np.zeros(channels), np.zeros(channels)
    turn_phases(azimuth, ring, columns, cos, sin)
    share = np.arctan2(sin, cos) / (2 * np.pi)
    return (np.round(share * _AZIMUTHS).astype(np.int64) % _AZIMUTHS).astype(np.uint16)


def _image(
    points: Floats, azimuth: Floats, rings: Rings, ring: Ints, room_m: float
) -> RingImage | None:
    some = slice(None, None, max(1, len(points) // _SAMPLE))
    _, _, sample = _measured(points[some], azimuth[some], rings, ring[some])
    usual_m = 1.1 * float(np.quantile(sample, _USUAL))
    reach_m = min(_BEAM_SHARE[1] * room_m, max(_BEAM_SHARE[0] * room_m, usual_m))
    if np.count_nonzero(sample > reach_m) > 2 * _MISFITS * len(sample):
        return None
    beam, range_m, beside_m = _measured(points, azimuth, rings, ring)
    beams = len(rings.elevations) * rings.columns
    image, owner = np.zeros(beams, np.float32), np.full(beams, -1, np.int32)
    misfits = np.empty(len(points), np.int64)
    count = assign_beams(beam, range_m, beside_m, reach_m, image, owner, misfits)
    if count > _MISFITS * len(points):
        return None
    shape = (len(rings.elevations), rings.columns)
    return RingImage(
        rings, image.reshape(shape), reach_m, owner[owner >= 0].astype(np.int64), misfits[:count]
    )


def _measured(
    points: Floats, azimuth: Floats, rings: Rings, ring: Ints
) -> tuple[Ints, Floats, Floats]:
    """Returns the beam of each point (N, 3), how far along it and how far beside it that lies."""
    turns, azimuths = rings.spin
    flat = np.sqrt(turns[:, 0] ** 2 + turns[:, 1] ** 2)
    leads_m = (rings.origin.radius_m / np.maximum(flat, MIN_FLAT)).astype(np.float32)
    turns = np.column_stack([turns, rings.azimuths / _AZIMUTHS, leads_m])
    lifted = points - [0.0, 0.0, rings.origin.height_m]
    beam = np.empty(len(points), np.int64)
    range_m, beside_m = np.empty(len(points)), np.empty(len(points))
    angles, ring = np.ascontiguousarray(azimuth), np.ascontiguousarray(ring)
    measure_beams(lifted, angles, turns, azimuths, ring, beam, range_m, beside_m)
    return beam, range_m, beside_m
