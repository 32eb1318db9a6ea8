"""Scans as bytes: what a LiDAR returned, quantised within a named error bound, then zstd.

A payload begins with 32 bytes: magic "SCAN", u8 form, u8 flags, u16 channels, u32 columns,
f32 upper and lower field of view (deg), f32 error bound (m), u32 points, u32 raw length.

    form 0  a range image: the firing pattern is known, so that one number a beam is enough.
            u16 range steps (0: no return), as differences along a ring, low bytes then high bytes
    form 1  an unordered cloud: i32 steps per axis, as differences, byte planes of x, y, z

With flag 1, one byte of intensity per beam or point follows. The bound holds for the distance
between each point and its decoded self; a form that could not keep it refuses the scan.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import zstandard
from numba import njit

from protocol.errors import CodecError

Floats32 = npt.NDArray[np.float32]

MAGIC = b"SCAN"
PREFIX = struct.Struct("<4sBBHIfffII")
RANGE_IMAGE, CLOUD = 0, 1
HAS_INTENSITY = 1
MAX_BEAMS = 1 << 20
MAX_POINTS = 4 << 20
_SLACK = 1e-2  # of the bound, kept back for float32 rounding
_LEVEL = 1  # zstd: higher levels gain under 2 % here and cost several times as much


@dataclass(frozen=True, slots=True)
class ScanPattern:
    """A LiDAR's firing pattern: rings of equal spacing, columns of equal azimuth."""

    channels: int
    columns: int
    upper_fov_deg: float
    lower_fov_deg: float

    def __post_init__(self) -> None:
        beams = self.channels * self.columns
        if not 1 <= beams <= MAX_BEAMS:
            raise CodecError(f"pattern {self.channels} x {self.columns}: 1 to {MAX_BEAMS} beams")
        if not -90 <= self.lower_fov_deg <= self.upper_fov_deg <= 90:
            raise CodecError(
                f"field of view {self.lower_fov_deg} to {self.upper_fov_deg} deg: "
                "needs -90 <= lower <= upper <= 90"
            )

    @property
    def directions(self) -> Floats32:
        """Unit vectors (channels, columns, 3) in the sensor frame.

        Row 0 is the uppermost ring; column c looks to azimuth 2 pi c / columns, CCW from +x.
        """
        return _directions(self)


@dataclass(frozen=True, slots=True, eq=False)
class RangeScan:
    """One revolution. `range_m` (channels, columns) is 0 where nothing came back."""

    pattern: ScanPattern
    range_m: Floats32
    intensity: Floats32

    def __post_init__(self) -> None:
        shape = (self.pattern.channels, self.pattern.columns)
        if self.range_m.shape != shape or self.intensity.shape != shape:
            raise CodecError(
                f"range has shape {self.range_m.shape}, intensity {self.intensity.shape}, "
                f"the pattern {shape}"
            )

    def cloud(self) -> PointCloud:
        """Returns the points in the sensor frame, ring by ring."""
        hit = self.range_m > 0
        points = self.pattern.directions[hit] * self.range_m[hit][:, None]
        return PointCloud(points, self.intensity[hit])


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points (N, 3) in the sensor frame, metres; intensity (N,) from 0 to 1, 0 where not sent."""

    points: Floats32
    intensity: Floats32


def encode_scan(scan: RangeScan, max_error_m: float, *, intensity: bool = False) -> bytes:
    """Encodes a structured scan; every point moves by at most `max_error_m` along its beam.

    Raises:
        CodecError: a range is not finite, negative, or beyond 65 534 steps of the bound.
    """
    _check_bound(max_error_m)
    pattern = scan.pattern
    step_m = _step(max_error_m)
    farthest_m = float(scan.range_m.max())
    if not (np.isfinite(farthest_m) and float(scan.range_m.min()) >= 0):
        raise CodecError("a range is negative or not finite")
    if farthest_m >= 65_533 * step_m:
        raise CodecError(
            f"range {farthest_m:.1f} m at a bound of {max_error_m} m: the form ends at "
            f"{65_533 * step_m:.1f} m"
        )
    raw = np.empty(scan.range_m.size * (3 if intensity else 2), np.uint8)
    points = _pack_ranges(np.ascontiguousarray(scan.range_m), 1.0 / step_m, raw)
    if intensity:
        raw[2 * scan.range_m.size :] = _byte_intensity(scan.intensity).ravel()
    head = (pattern.channels, pattern.columns, pattern.upper_fov_deg, pattern.lower_fov_deg)
    return _seal(RANGE_IMAGE, head, (max_error_m, points), raw, intensity)


def encode_cloud(cloud: PointCloud, max_error_m: float, *, intensity: bool = False) -> bytes:
    """Encodes an unordered cloud; points keep their order and move by at most `max_error_m`.

    Raises:
        CodecError: a coordinate is not finite or too far away for the bound.
    """
    _check_bound(max_error_m)
    points = np.asarray(cloud.points, np.float64).reshape(-1, 3)
    if len(points) > MAX_POINTS:
        raise CodecError(f"cloud has {len(points)} points, limit {MAX_POINTS}")
    if not np.isfinite(points).all():
        raise CodecError("a coordinate is not finite")
    step_m = _step(max_error_m) / np.sqrt(3)
    if len(points) and float(np.abs(points).max()) > _farthest_m(max_error_m, step_m):
        raise CodecError(
            f"coordinate {np.abs(points).max():.1f} m at a bound of {max_error_m} m: float32 or "
            f"the form ends at {_farthest_m(max_error_m, step_m):.1f} m"
        )
    steps = np.round(points / step_m).astype(np.int32)
    change = np.diff(steps, axis=0, prepend=np.zeros((1, 3), np.int32))
    zigzag = ((change << 1) ^ (change >> 31)).astype("<u4")
    planes = np.ascontiguousarray(zigzag.T).view(np.uint8).reshape(3, -1, 4).transpose(0, 2, 1)
    raw = planes.ravel()
    if intensity:
        raw = np.concatenate([raw, _byte_intensity(cloud.intensity)])
    return _seal(CLOUD, (0, 0, 0.0, 0.0), (max_error_m, len(points)), raw, intensity)


def decode(payload: bytes | npt.NDArray[np.uint8]) -> PointCloud:
    """Reads a payload of either form; the points come back in the sensor frame.

    Raises:
        CodecError: the payload is not one, or claims a size beyond the limits.
    """
    data = payload if isinstance(payload, bytes) else payload.tobytes()
    if len(data) < PREFIX.size:
        raise CodecError(f"scan has {len(data)} bytes, its prefix alone takes {PREFIX.size}")
    magic, form, flags, channels, columns, upper, lower, bound_m, points, raw_len = (
        PREFIX.unpack_from(data)
    )
    if magic != MAGIC or form not in (RANGE_IMAGE, CLOUD) or flags & ~HAS_INTENSITY:
        raise CodecError(f"scan begins with {magic!r}, form {form}, flags {flags}")
    _check_bound(bound_m)
    with_intensity = bool(flags & HAS_INTENSITY)
    if form == CLOUD:
        if points > MAX_POINTS:
            raise CodecError(f"scan claims {points} points, limit {MAX_POINTS}")
        raw = _unseal(data, raw_len, points * (13 if with_intensity else 12))
        return _open_cloud(raw, points, bound_m, with_intensity)
    pattern = ScanPattern(channels, columns, upper, lower)
    beams = channels * columns
    raw = _unseal(data, raw_len, beams * (3 if with_intensity else 2))
    xyz = np.empty((beams, 3), np.float32)
    shade = np.zeros(beams, np.float32)
    directions = pattern.directions.reshape(-1, 3)
    found = _unpack_ranges(raw, directions, columns, _step(bound_m), xyz, shade)
    if found != points:
        raise CodecError(f"scan claims {points} points, holds {found}")
    return PointCloud(xyz[:found], shade[:found])


def _step(bound_m: float) -> float:
    return 2.0 * float(np.float32(bound_m)) * (1.0 - _SLACK)


def _farthest_m(bound_m: float, step_m: float) -> float:
    return min((2**30 - 1) * step_m, bound_m * _SLACK * 2**23)  # half an ulp per axis


def _check_bound(max_error_m: float) -> None:
    if not (np.isfinite(max_error_m) and max_error_m * (1 + 1e-6) >= 1e-4 and max_error_m <= 10):
        raise CodecError(f"error bound {max_error_m} m: needs 0.0001 to 10")


def _byte_intensity(intensity: Floats32) -> npt.NDArray[np.uint8]:
    return np.clip(np.round(intensity * 255.0), 0, 255).astype(np.uint8)


def _seal(
    form: int,
    head: tuple[int, int, float, float],
    claim: tuple[float, int],
    raw: npt.NDArray[np.uint8],
    intensity: bool,
) -> bytes:
    flags = HAS_INTENSITY if intensity else 0
    prefix = PREFIX.pack(MAGIC, form, flags, *head, *claim, raw.size)
    return prefix + zstandard.ZstdCompressor(level=_LEVEL).compress(raw.data)


def _unseal(data: bytes, raw_len: int, needed: int) -> npt.NDArray[np.uint8]:
    if raw_len != needed:
        raise CodecError(f"scan claims {raw_len} raw bytes, its form takes {needed}")
    body = data[PREFIX.size :]
    try:
        claimed = zstandard.get_frame_parameters(body).content_size
        if claimed != needed:
            raise CodecError(f"zstd frame claims {claimed} bytes, the scan {needed}")
        raw = zstandard.ZstdDecompressor().decompress(
            body, max_output_size=needed, allow_extra_data=False
        )
    except zstandard.ZstdError as error:
        raise CodecError(f"zstd: {error}") from None
    if len(raw) != needed:
        raise CodecError(f"zstd frame holds {len(raw)} bytes, the scan claims {needed}")
    return np.frombuffer(raw, np.uint8)


def _open_cloud(
    raw: npt.NDArray[np.uint8], points: int, bound_m: float, with_intensity: bool
) -> PointCloud:
    planes = raw[: 12 * points].reshape(3, 4, points).transpose(0, 2, 1)
    zigzag = np.ascontiguousarray(planes).view("<u4").reshape(3, points).T
    change = (zigzag >> 1).astype(np.int64) ^ -(zigzag & 1).astype(np.int64)
    steps = np.cumsum(change, axis=0)
    if points and int(np.abs(steps).max()) > 2**31:
        raise CodecError("a coordinate lies beyond the form's reach")
    xyz = (steps * (_step(bound_m) / np.sqrt(3))).astype(np.float32)
    shade = raw[12 * points :] / np.float32(255) if with_intensity else np.zeros(points)
    return PointCloud(xyz, shade.astype(np.float32))


@lru_cache(maxsize=16)
def _directions(pattern: ScanPattern) -> Floats32:
    elevation = np.radians(
        np.linspace(pattern.upper_fov_deg, pattern.lower_fov_deg, pattern.channels)
    )[:, None]
    azimuth = np.arange(pattern.columns)[None, :] * (2 * np.pi / pattern.columns)
    flat = np.cos(elevation)
    up = np.broadcast_to(np.sin(elevation), (pattern.channels, pattern.columns))
    result = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], -1).astype(np.float32)
    result.setflags(write=False)
    return result


@njit("int64(float32[:,::1], float64, uint8[::1])", cache=True)
def _pack_ranges(range_m: Floats32, per_step: float, raw: npt.NDArray[np.uint8]) -> int:
    """Writes differences along each ring as byte planes; returns the number of returns."""
    rows, columns = range_m.shape
    beams = rows * columns
    points = 0
    for row in range(rows):
        before = 0
        for column in range(columns):
            metres = range_m[row, column]
            steps = 0
            if metres > 0:
                steps = int(np.floor(metres * per_step + 0.5)) + 1
                points += 1
            change = (steps - before) & 0xFFFF
            before = steps
            change = ((change << 1) ^ (0xFFFF if change & 0x8000 else 0)) & 0xFFFF
            at = row * columns + column
            raw[at] = change & 0xFF
            raw[beams + at] = change >> 8
    return points


@njit(
    "int64(Array(uint8, 1, 'C', readonly=True), Array(float32, 2, 'C', readonly=True), int64, "
    "float64, float32[:,::1], float32[::1])",
    cache=True,
)
def _unpack_ranges(
    raw: npt.NDArray[np.uint8],
    directions: Floats32,
    columns: int,
    step_m: float,
    xyz: Floats32,
    shade: Floats32,
) -> int:
    """Fills points and intensities of all beams that returned; returns their number."""
    beams = directions.shape[0]
    with_intensity = raw.size > 2 * beams
    found = 0
    steps = 0
    for at in range(beams):
        if at % columns == 0:
            steps = 0
        change = raw[at] | (raw[beams + at] << 8)
        change = (change >> 1) ^ (0xFFFF if change & 1 else 0)
        steps = (steps + change) & 0xFFFF
        if steps > 0:
            metres = (steps - 1) * step_m
            xyz[found, 0] = directions[at, 0] * metres
            xyz[found, 1] = directions[at, 1] * metres
            xyz[found, 2] = directions[at, 2] * metres
            if with_intensity:
                shade[found] = raw[2 * beams + at] / np.float32(255)
            found += 1
    return found
