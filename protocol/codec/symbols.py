"""Streams of symbols as sections of a payload: the tables, then the words of the coder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.codec.payload import Reader
from protocol.codec.rans import SHARES, STATES, encode_symbols, open_tables
from protocol.codec.tables import choose_tables, read_tables, spread, write_tables
from protocol.codec.tokens import I8, TAIL_ALPHABET, U1, U2, U4
from protocol.errors import CodecError


@dataclass(frozen=True, slots=True, eq=False)
class SymbolStream:
    """What a decoder needs: words with zeros behind them, `end` of the words, and tables.

    `table_of` is the table of each context, `slots` (tables * 4096,) and `place`
    (tables * TAIL_ALPHABET,) are those of `open_tables`.
    """

    words: U2
    end: int
    table_of: U1
    slots: U1
    place: U4


def pack_symbols(symbols: U2, count: int, counts: I8) -> list[bytes]:
    """Returns the sections of the first `count` symbols.

    Args:
        symbols: `state << TURN_SHIFT | context * TAIL_ALPHABET + token`.
        count: how many of them.
        counts: (contexts, TAIL_ALPHABET), how often each occurs.
    """
    contexts = len(counts)
    table_of = np.zeros(contexts, np.uint8)
    levels = np.zeros((contexts, TAIL_ALPHABET), np.uint8)
    tables = choose_tables(counts, table_of, levels)
    written = np.zeros(contexts + tables * 2 * TAIL_ALPHABET, np.uint8)
    length = write_tables(table_of, levels, tables, written)
    shares = np.zeros((tables, TAIL_ALPHABET), np.uint16)
    spread(levels, tables, shares)
    words = np.empty(count + 2 * STATES, np.uint16)
    start = encode_symbols(symbols, count, shares[table_of], words)
    return [written[:length].tobytes(), words[start:].astype("<u2", copy=False).tobytes()]


def open_symbols(reader: Reader, contexts: int, room: int) -> SymbolStream:
    """Reads the sections of `pack_symbols`.

    Args:
        reader: of the payload.
        contexts: of the form.
        room: how many words the decoder may read beyond the end before it looks.

    Raises:
        CodecError: they do not hold tables and words.
    """
    written, body = reader.section(), reader.section()
    if len(body) % 2 or len(body) < 4 * STATES:
        raise CodecError(f"scan has {len(body)} bytes of symbols")
    table_of = np.zeros(contexts, np.uint8)
    levels = np.zeros((contexts, TAIL_ALPHABET), np.uint8)
    tables = read_tables(np.frombuffer(written, np.uint8), table_of, levels)
    if tables < 0:
        raise CodecError("the tables of a scan are damaged")
    shares = np.zeros((tables, TAIL_ALPHABET), np.uint16)
    spread(levels, tables, shares)
    slots = np.empty((tables, SHARES), np.uint8)
    place = np.empty((tables, TAIL_ALPHABET), np.uint32)
    open_tables(shares, slots, place)
    end = len(body) // 2
    words = np.zeros(end + room, np.uint16)
    words[:end] = np.frombuffer(body, "<u2")
    return SymbolStream(words, end, table_of, slots.ravel(), place.ravel())


def read_raw(section: bytes) -> U4:
    """Returns the words of raw bits.

    Raises:
        CodecError: they are not whole.
    """
    if len(section) % 4:
        raise CodecError(f"scan has {len(section)} bytes of raw bits")
    return np.frombuffer(section, "<u4").astype(np.uint32)
