"""Range images as sections of a payload: the window that holds returns, then its symbols."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.codec.beam_origin import BeamOrigin
from protocol.codec.payload import Head, Reader
from protocol.codec.prediction import (
    CONTEXT_OF,
    CONTEXTS,
    COUNTS,
    MAX_UNITS,
    NEXT_KIND,
    STRIDE,
    UNITS,
    distance_marks,
    symbol_room,
)
from protocol.codec.range_image import image_to_symbols, symbols_to_points
from protocol.codec.rans import I8, U1, U4, i64
from protocol.codec.symbols import pack_symbols, read_raw, unpack_symbols
from protocol.errors import CodecError
from protocol.scans import Floats, Floats32

BLOCK = 4  # columns that stay together
WORTH = 0.75  # of the image: a window that is larger is not worth the copy

Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A window of a range image: masks of its rings (channels,) and columns (columns,)."""

    rings: Bools
    columns: Bools

    @classmethod
    def around(cls, range_m: Floats32) -> Window | None:
        """Returns the window of all returns of an image; None if it is hardly smaller."""
        channels, columns = range_m.shape
        rings = np.zeros(channels, np.uint8)
        blocks = np.zeros(-(-columns // BLOCK), np.uint8)
        _mark(range_m, rings, blocks)
        rings[0] |= not rings.any()  # an image without returns keeps one ring and one block
        blocks[0] |= not blocks.any()
        if int(rings.sum()) * int(blocks.sum()) > WORTH * channels * len(blocks):
            return None
        return cls(rings.astype(bool), np.repeat(blocks, BLOCK)[:columns].astype(bool))

    def cut(self, range_m: Floats32) -> Floats32:
        """Returns the window of an image."""
        return np.ascontiguousarray(range_m[self.rings][:, self.columns])

    def cut_spin(self, spin: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """Returns the window's rings and columns of a pattern's; see `ScanPattern.spin`."""
        turns, azimuths = spin
        return np.ascontiguousarray(turns[self.rings]), np.ascontiguousarray(azimuths[self.columns])

    def to_bytes(self) -> bytes:
        """Returns a bit for each ring, then one for each block of columns."""
        return np.packbits(self.rings).tobytes() + np.packbits(self.columns[::BLOCK]).tobytes()

    @classmethod
    def from_bytes(cls, data: bytes, channels: int, columns: int) -> Window:
        """Reverses `to_bytes`.

        Raises:
            CodecError: it is not a window of such an image, or an empty one.
        """
        blocks = -(-columns // BLOCK)
        first = -(-channels // 8)
        needed = first + -(-blocks // 8)
        if len(data) != needed:
            raise CodecError(f"a window has {len(data)} bytes, needs {needed}")
        bits = np.frombuffer(data, np.uint8)
        rings = np.unpackbits(bits[:first], count=channels).astype(bool)
        columns_in = np.repeat(np.unpackbits(bits[first:], count=blocks), BLOCK)[:columns]
        if not (rings.any() and columns_in.any()):
            raise CodecError("a window is empty")
        return cls(rings, columns_in.astype(bool))


@njit("void(float32[:,::1], uint8[::1], uint8[::1])", cache=True, nogil=True)
def _mark(range_m: Floats32, rings: U1, blocks: U1) -> None:
    missing = blocks.size
    for ring in range(range_m.shape[0] - 1, -1, -1):  # from below, where the returns are
        for block in range(blocks.size):
            if rings[ring] and missing == 0:
                break
            if rings[ring] and blocks[block]:
                continue
            for column in range(block * BLOCK, min((block + 1) * BLOCK, range_m.shape[1])):
                if range_m[ring, column] > 0:
                    missing -= 1 - blocks[block]
                    rings[ring], blocks[block] = 1, 1
                    break


_QUANTISED = 1.0 - 1.0 / UNITS  # half a unit is lost on each side before steps are taken
_CONTEXTS = CONTEXT_OF.tobytes()
_SIGMAS_OF_JUMP = 4.0
_FLOOR = 0.25  # of the gain
_SAMPLED_ROWS = 5
_NOISE_OF_BIN = 1 / 2000.0 / (0.6745 * math.sqrt(2.0))  # median of differences, half a millimetre


def image_step_m(room_m: float) -> float:
    """Returns the step of range for which every decoded range is within `room_m` of its own."""
    return 2.0 * room_m * _QUANTISED


def pack_image(range_m: Floats32, step_m: float) -> tuple[list[bytes], int]:
    """Returns the sections of an image (channels, columns) and the number of its points.

    Raises:
        CodecError: a range takes too many steps.
    """
    channels, columns = range_m.shape
    units_per_m = UNITS / step_m
    if float(range_m.max()) * units_per_m > MAX_UNITS:
        raise CodecError(f"range {range_m.max():.1f} m takes too many steps of {step_m} m")
    tuning = _tune(_noise_m(range_m) / step_m)
    symbols, raw = _scratch(channels, columns)
    counts, sizes = np.zeros((2, COUNTS), np.int32), np.zeros(3, np.int64)
    given = (range_m, units_per_m, tuning, distance_marks(units_per_m))
    image_to_symbols(*given, CONTEXT_OF, NEXT_KIND, symbols, raw, counts, sizes)
    per_context = counts[:, : CONTEXTS * STRIDE].sum(axis=0, dtype=np.int64)
    sections = pack_symbols(symbols, int(sizes[0]), per_context.reshape(CONTEXTS, STRIDE))
    settings = tuning.astype(np.uint8).tobytes()
    return [settings, *sections, raw[: sizes[1]].astype("<u4", copy=False).tobytes()], int(sizes[2])


_kept = threading.local()


def _scratch(channels: int, columns: int) -> tuple[U4, U4]:
    """Returns this thread's buffers for symbols and raw bits: fresh memory takes longer."""
    symbols: U4 | None = getattr(_kept, "symbols", None)
    needed = symbol_room(channels, columns)
    if symbols is None or len(symbols) < needed:
        symbols = _kept.symbols = np.empty(needed, np.uint32)
        _kept.raw = np.empty(needed, np.uint32)
    return symbols, _kept.raw


def unpack_image(
    head: Head, reader: Reader, spin: tuple[Floats, Floats], origin: BeamOrigin, points: int
) -> Floats32:
    """Reads the sections of `pack_image` and returns points (points, 3), ring by ring.

    Args:
        head: of the payload.
        reader: at the image.
        spin: of the image's beams, as `ScanPattern.spin`.
        origin: where they begin.
        points: how many the image claims, at most as many as it has beams.

    Raises:
        CodecError: the sections are damaged.
    """
    settings = reader.section()
    if len(settings) != 4:
        raise CodecError(f"an image has {len(settings)} bytes of settings, needs 4")
    tuning = np.frombuffer(settings, np.uint8, 4).astype(np.int64)
    if tuning[2] > 15 or tuning[3] > tuning[2]:
        raise CodecError(f"an image has settings {tuning.tolist()}")
    stream = unpack_symbols(reader, (CONTEXTS, STRIDE), symbol_room(1, head.columns))
    raw = read_raw(reader.section())
    xyz = np.empty((points + 1, 3), np.float32)
    tables = stream.table_of.tobytes()
    tables = _CONTEXTS.translate(tables.ljust(256)) + tables[-4:]
    coded = (stream.words, stream.end, raw, np.frombuffer(tables, np.uint8), stream.slots)
    model = (stream.place, tuning, distance_marks(UNITS / head.step_m))
    placing = (head.step_m / UNITS, *spin, (origin.height_m, origin.radius_m), xyz)
    if symbols_to_points(*coded, *model, NEXT_KIND, *placing) < 0:
        raise CodecError("an image is damaged, or holds other than the points it claims")
    return xyz[:points]


def _tune(noise_steps: float) -> I8:
    """Returns the settings of the model for range noise of this standard deviation in steps.

    Floor of the gain in 1/256: the coarser the steps, the more information each carries. Steps that
    make a jump. Shift of activities, so that noise alone is one or two. Lowest bits that are noise.
    """
    gain = min(0.68, max(_FLOOR, 0.84 - 3.2 * noise_steps))
    jump = min(255, max(2, math.ceil(_SIGMAS_OF_JUMP * noise_steps)))
    shift = min(15, max(0, round(math.log2(max(noise_steps, 1e-3)))))
    return np.array([round(gain * UNITS), jump, shift, max(0, shift - 1)], np.int64)


@njit("float64(float32[:,::1])", cache=True, nogil=True)
def _noise_m(range_m: Floats32) -> float:
    """Estimates the standard deviation of range noise.

    From the median of the differences between neighbours in a few of the lower rings; slopes of the
    scene add to it, which does no harm.
    """
    channels, columns = range_m.shape
    bins = np.zeros(256, np.int64)
    pairs = 0
    for n in range(_SAMPLED_ROWS):
        row = channels - 1 - n * channels // (2 * _SAMPLED_ROWS)
        for column in range(1, columns):
            a, b = range_m[row, column - 1], range_m[row, column]
            if a > 0 and b > 0:
                bins[min(255, i64(abs(a - b) * 2000.0))] += 1
                pairs += 1
    below = 0
    for n in range(256):
        below += bins[n]
        if 2 * below >= pairs:
            return (n + 0.5) * _NOISE_OF_BIN
    return 0.0
