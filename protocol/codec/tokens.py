"""Residuals as tokens of a small alphabet, and the raw bits that go beside them.

A residual k is folded (0, -1, 1, -2, 2 become 0, 1, 2, 3, 4); its `low` lowest bits, which are
noise at a fine bound, are raw. What is left is a token of its own below `ESCAPE`. From there a
second token names the power of two and its half, and the bits below that are raw too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

ESCAPE = 15
TAIL_ALPHABET = 64

# As Any, for in a kernel they are plain numbers of their width.
i64: Any = np.int64
u64: Any = np.uint64

I2 = npt.NDArray[np.int16]
U1 = npt.NDArray[np.uint8]
U2 = npt.NDArray[np.uint16]
U4 = npt.NDArray[np.uint32]
I4 = npt.NDArray[np.int32]
I8 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint64]


@njit("int64(int64)", cache=True, nogil=True)
def fold(k: int) -> int:
    """Folds a signed number into one that is not, those near 0 first."""
    return (k << 1) ^ (k >> 63)


@njit("int64(int64)", cache=True, nogil=True)
def unfold(u: int) -> int:
    """Reverses `fold`."""
    return (u >> 1) ^ -(u & 1)


@njit("int64(int64)", cache=True, nogil=True)
def tail_token(over: int) -> int:
    """Returns the second token of a number that lies `over` above the escape: 0, 1, then pairs."""
    if over < 2:
        return over
    e = 1
    while over >> (e + 1):
        e += 1
    return 2 * e + ((over >> (e - 1)) & 1)


@njit("int64(int64)", cache=True, nogil=True)
def tail_bits(token: int) -> int:
    """Returns how many raw bits follow a second token."""
    return max(0, (token >> 1) - 1)


@njit("int64(int64)", cache=True, nogil=True)
def tail_base(token: int) -> int:
    """Returns the smallest number of a second token."""
    if token < 2:
        return token
    return (2 | (token & 1)) << ((token >> 1) - 1)
