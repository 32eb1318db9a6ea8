"""The container format of a scan payload: a prefix, then sections of stated length.

The prefix is 40 bytes: magic "SCAN", u8 form, u8 flags, u16 channels, u32 columns, u32 points,
f32 upper and lower field of view (deg), f64 step (m), u32 length of what follows, u32 zero. A
pattern whose rings are not of equal spacing puts a section first: i16 of 0.01 deg by ring.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt
import zstandard

from protocol.errors import CodecError
from protocol.limits import MAX_POINTS, MAX_STEP_M, MIN_STEP_M
from protocol.scans import Floats32, check_beams

MAGIC = b"SCAN"
PREFIX = struct.Struct("<4sBBHIIffdII")
HAS_INTENSITY, HAS_ELEVATIONS = 1, 2
_FLAGS = HAS_INTENSITY | HAS_ELEVATIONS
_ELEVATION_UNITS = 100.0  # per deg
_LENGTH = struct.Struct("<I")
_LEVEL = 1  # zstd: higher levels gain under 2 % here and cost several times as much


class Form(IntEnum):
    """How a payload is laid out: the first two hold scans, the others clouds.

    A form whose sections change gets a new number; 2 and 4 to 7 are of older versions.
    """

    PLANES = 0
    IMAGE = 1
    DELTAS = 3
    TREE = 8
    RINGS = 9


_IMAGES = (Form.PLANES, Form.IMAGE)


@dataclass(frozen=True, slots=True)
class Head:
    """The fields of the prefix. The pattern is zeros for a cloud without one."""

    form: Form
    points: int
    step_m: float
    channels: int = 0
    columns: int = 0
    upper_fov_deg: float = 0.0
    lower_fov_deg: float = 0.0
    with_intensity: bool = False
    elevations_deg: tuple[float, ...] = ()

    def seal(self, *sections: bytes) -> bytes:
        """Assembles a payload from its prefix and sections."""
        flags = HAS_INTENSITY if self.with_intensity else 0
        if self.elevations_deg:
            flags |= HAS_ELEVATIONS
            units = np.round(np.array(self.elevations_deg) * _ELEVATION_UNITS)
            sections = units.astype("<i2").tobytes(), *sections
        body = b"".join(_LENGTH.pack(len(section)) + section for section in sections)
        prefix = PREFIX.pack(
            MAGIC,
            self.form,
            flags,
            self.channels,
            self.columns,
            self.points,
            self.upper_fov_deg,
            self.lower_fov_deg,
            self.step_m,
            len(body),
            0,
        )
        return prefix + body


class Reader:
    """Hands out the sections of a payload, each once and in order."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data = data
        self._at = at

    def section(self) -> bytes:
        """Returns the next section.

        Raises:
            CodecError: it is not there in full.
        """
        body = self._at + _LENGTH.size
        if body > len(self._data):
            raise CodecError(f"scan ends at byte {len(self._data)}, within a section's length")
        (length,) = _LENGTH.unpack_from(self._data, self._at)
        if length > len(self._data) - body:
            raise CodecError(f"section claims {length} bytes, {len(self._data) - body} are there")
        self._at = body + length
        return self._data[body : self._at]

    def end(self) -> None:
        """Checks that no bytes are left.

        Raises:
            CodecError: bytes are left.
        """
        if self._at != len(self._data):
            raise CodecError(f"scan has {len(self._data) - self._at} bytes too many")


def read_payload(data: bytes) -> tuple[Head, Reader]:
    """Reads the prefix and checks its sizes against the limits.

    Raises:
        CodecError: it is not a scan, or claims a size beyond the limits.
    """
    if len(data) < PREFIX.size:
        raise CodecError(f"scan has {len(data)} bytes, its prefix alone takes {PREFIX.size}")
    magic, form, flags, channels, columns, points, upper, lower, step_m, length, zero = (
        PREFIX.unpack_from(data)
    )
    if magic != MAGIC or form not in tuple(Form) or flags & ~_FLAGS or zero:
        raise CodecError(f"scan begins with {magic!r}, form {form}, flags {flags}")
    if length != len(data) - PREFIX.size:
        raise CodecError(f"scan claims {length} bytes, {len(data) - PREFIX.size} are there")
    if not (np.isfinite(step_m) and MIN_STEP_M <= step_m <= MAX_STEP_M):
        raise CodecError(f"scan claims a step of {step_m} m")
    if points > MAX_POINTS:
        raise CodecError(f"scan claims {points} points, limit {MAX_POINTS}")
    if form in (*_IMAGES, Form.RINGS):
        check_beams(channels, columns)
    if form in _IMAGES and points > channels * columns:
        raise CodecError(f"scan claims {points} points of {channels} x {columns} beams")
    reader = Reader(data, PREFIX.size)
    elevations_deg: tuple[float, ...] = ()
    if flags & HAS_ELEVATIONS:
        if form not in _IMAGES:
            raise CodecError(f"scan of form {form} claims elevations of rings")
        elevations_deg = _read_elevations(reader.section(), channels)
    with_intensity = bool(flags & HAS_INTENSITY)
    beams = channels, columns
    head = Head(Form(form), points, step_m, *beams, upper, lower, with_intensity, elevations_deg)
    return head, reader


def _read_elevations(section: bytes, channels: int) -> tuple[float, ...]:
    if len(section) != 2 * channels:
        raise CodecError(f"elevations of {channels} rings take {len(section)} bytes")
    units = np.frombuffer(section, "<i2").astype(np.float64)
    return tuple((units / _ELEVATION_UNITS).tolist())


def claimed_points(payload: npt.NDArray[np.uint8]) -> int:
    """Returns how many points a payload's prefix states; 0 if the payload is too short.

    One that claims more than the limit is refused before anything is allocated: it counts as 0.
    """
    if len(payload) < PREFIX.size:
        return 0
    points: int = PREFIX.unpack_from(payload.data)[5]
    return points if points <= MAX_POINTS else 0


def compress(raw: npt.NDArray[np.uint8]) -> bytes:
    """Returns a zstd frame that states its size."""
    return zstandard.ZstdCompressor(level=_LEVEL).compress(np.ascontiguousarray(raw).data)


def decompress(frame: bytes, needed: int) -> npt.NDArray[np.uint8]:
    """Decompresses a frame that must hold this many bytes; never more are written.

    Raises:
        CodecError: it holds more or fewer, or is no zstd frame.
    """
    try:
        claimed = zstandard.get_frame_parameters(frame).content_size
        if claimed != needed:
            raise CodecError(f"zstd frame claims {claimed} bytes, the scan {needed}")
        raw = zstandard.ZstdDecompressor().decompress(
            frame, max_output_size=needed, allow_extra_data=False
        )
    except zstandard.ZstdError as error:
        raise CodecError(f"zstd: {error}") from None
    if len(raw) != needed:
        raise CodecError(f"zstd frame holds {len(raw)} bytes, the scan claims {needed}")
    return np.frombuffer(raw, np.uint8)


def pack_intensity(intensity: Floats32, wanted: bool) -> list[bytes]:
    """Returns the section of intensities (N,), a byte each; none if they are not sent."""
    if not wanted:
        return []
    return [compress(np.clip(np.round(intensity * 255.0), 0, 255).astype(np.uint8))]


def unpack_intensity(head: Head, reader: Reader) -> Floats32:
    """Reads the section of intensities; zeros if they were not sent.

    Raises:
        CodecError: the section does not hold one byte for each point.
    """
    if not head.with_intensity:
        return np.zeros(head.points, np.float32)
    raw = decompress(reader.section(), head.points)
    return raw.astype(np.float32) / np.float32(255)
