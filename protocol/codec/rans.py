"""The entropy coder: residuals as tokens, and rANS with static tables, eight states in turn.

A residual k is folded (0, -1, 1, -2, 2 become 0, 1, 2, 3, 4); its `low` lowest bits, which are
noise at a fine bound, are raw. What is left is a token of its own below `ESCAPE`. From there a
second token names the power of two and its half, and the bits below that are raw too.

A symbol is `context * stride + token`; a table gives each token of a context its share of 4096.
The encoder goes through the symbols backwards, so that the decoder goes forwards and chooses each
context by what it already knows. Source: Duda, arXiv:1311.2540; Giesen, arXiv:1402.3392.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

ESCAPE = 15
TAIL_ALPHABET = 64

# As Any, for in a kernel they are plain numbers of their width.
i32: Any = np.int32
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


STATES = 8
SHARE_BITS = 12
SHARES = 1 << SHARE_BITS
TURN_SHIFT = 16  # of the state's number above the symbol
START = 1 << 16  # every state begins and ends here, which reveals a damaged payload


@njit("int64(uint32[::1], int64, uint16[:,::1], uint16[::1])", cache=True, nogil=True)
def encode_symbols(symbols: U4, count: int, shares: U2, words: U2) -> int:
    """Writes words from the end of `words` backwards; returns where they begin.

    Args:
        symbols: `state << TURN_SHIFT | context * stride + token`.
        count: how many of them.
        shares: (contexts, stride), each row's sum 4096, none above 4095.
        words: room for `count` and the states.
    """
    contexts, stride = shares.shape
    inverse = np.empty(contexts * stride, np.uint64)
    place = np.empty(contexts * stride, np.uint32)
    for context in range(contexts):
        below = 0
        for token in range(stride):
            share = i64(shares[context, token])
            if share > 0:
                # Exact for states below share << 20 and shares below 4096.
                inverse[context * stride + token] = u64((1 << 44) // share + 1)
                place[context * stride + token] = np.uint32(share | (below << 16))
                below += share
    states = np.full(STATES, START, np.uint64)
    at = len(words)
    for n in range(count - 1, -1, -1):
        symbol = symbols[n] & ((1 << TURN_SHIFT) - 1)
        turn = symbols[n] >> TURN_SHIFT
        state = states[turn]
        share = u64(place[symbol] & np.uint32(0xFFFF))
        if state >= share << u64(20):
            at -= 1
            words[at] = np.uint16(state & u64(0xFFFF))
            state >>= u64(16)
        quotient = (state * inverse[symbol]) >> u64(44)
        low = u64(place[symbol] >> np.uint32(16))
        states[turn] = state + low + quotient * (u64(SHARES) - share)
    for n in range(STATES - 1, -1, -1):
        words[at - 1] = np.uint16(states[n] & u64(0xFFFF))
        words[at - 2] = np.uint16(states[n] >> u64(16))
        at -= 2
    return at


@njit("void(uint16[:,::1], uint8[:,::1], uint32[:,::1])", cache=True, nogil=True)
def fill_lookup(shares: U2, slots: U1, place: U4) -> None:
    """Fills the decoder's look-up tables: the token of each slot, and each token's place."""
    contexts, stride = shares.shape
    for context in range(contexts):
        below = 0
        for token in range(stride):
            share = i64(shares[context, token])
            place[context, token] = np.uint32(share | (below << 16))
            slots[context, below : below + share] = token
            below += share


@njit("uint64(uint64, uint32)", cache=True, nogil=True)
def advance(state: int, where: int) -> int:
    """Returns a decoder's state behind a symbol whose place is `where`; it may need a word."""
    share, below = u64(where & np.uint32(0xFFFF)), u64(where >> np.uint32(16))
    slot = state & u64(SHARES - 1)
    result: int = share * (state >> u64(SHARE_BITS)) + slot - below
    return result


@njit("uint64(uint64, uint16)", cache=True, nogil=True)
def refill(state: int, word: int) -> int:
    """Returns the state with the next word, if it needs one."""
    short = u64(state < u64(START))
    result: int = (state << (short << u64(4))) | (u64(word) * short)
    return result


@njit("uint64(uint64)", cache=True, nogil=True)
def is_short(state: int) -> int:
    """Returns 1 if the state needs a word."""
    result: int = u64(state < u64(START))
    return result


@njit("void(uint16[::1], uint64[::1])", cache=True, nogil=True)
def read_states(words: U2, states: U8) -> None:
    """Fills the states of the entropy coder."""
    for n in range(STATES):
        states[n] = (u64(words[2 * n]) << u64(16)) | u64(words[2 * n + 1])


@njit("boolean(uint64[::1])", cache=True, nogil=True)
def states_are_final(states: U8) -> bool:
    """Returns whether all states are where they began: if not, the payload is damaged."""
    done = True
    for n in range(STATES):
        done &= states[n] == u64(START)
    return done
