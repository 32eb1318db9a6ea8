"""The rings and columns of an image in which anything came back: the rest need not be coded.

A part of a scan, such as what is left without the ground, leaves most rings and columns empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.codec.tokens import U1
from protocol.errors import CodecError
from protocol.scans import Floats, Floats32

BLOCK = 4  # columns that stay together
WORTH = 0.75  # of the image: a window that is larger is not worth the copy

Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Which rings (channels,) and columns (columns,) of an image are in it."""

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
