"""Changes to inputs that know how these are built, so that what is wrong lies deep within them."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import msgpack
import numpy as np
import zstandard

from protocol.codec.payload import PREFIX as SCAN_PREFIX
from protocol.errors import ProtocolError
from protocol.messages import Scan
from protocol.wire import PREFIX, decode, encode

Mutator = Callable[[Random, bytes, Sequence[bytes]], bytes]
"""Takes a generator, an input and others of its kind."""

_EDGES = (0, 1, -1, 2, 7, 15, 16, 31, 32, 63, 64, 127, 128, 255, 256, 1023, 4095, 4096, 32767)
_LARGE = (1 << 16, 1 << 19, 1 << 20, 1 << 24, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 40)
_FLOATS = (0.0, -0.0, 1e-300, 1e-9, 1e9, 1e38, 3.5e38, 1e308, float("inf"), float("nan"), -1.0)
_EVIL: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 64, 65, 4096, 1 << 31, 1 << 40, (1 << 40) - 1, (1 << 53) - 1,
    (1 << 62) - 1, 1 << 62, -(1 << 62), (1 << 63) - 1, (1 << 64) - 1, -(1 << 63), *_FLOATS,
    "", "a", "*", "a/b", "..", "\0", "\n", "x" * 129, "x" * 513, "é" * 200, b"\xff", b"", [], {},
    [[]], [[[[[]]]]], {"a": {}}, {"": 0}, {b"\xff": 1}, [0], [-1], [1 << 40], [3, 3],
    msgpack.ExtType(5, b"abc"), msgpack.Timestamp(1, 2),
)  # fmt: skip
_HEAVY: tuple[Any, ...] = (["a"] * 4097, [None] * 300, [{}] * 300, [[]] * 300, "x" * 5000)
_HEAVY_SHARE = 0.002  # they take a hundred times as long; larger ones are bombs
_EDGE_BYTES = [
    (number & ((1 << 8 * width) - 1)).to_bytes(width, "little")
    for width in (1, 2, 4, 8)
    for number in _EDGES + _LARGE
]
_EDGE_BYTES += [struct.pack("<d", value) for value in _FLOATS]
_EDGE_BYTES += [
    struct.pack("<I", bits) for bits in (0x7F800000, 0xFF800000, 0x7FC00000, 0x7F7FFFFF)
]
_ZSTD = b"\x28\xb5\x2f\xfd"
_MOST_RAW = 1 << 20


def shake(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes bytes that mean nothing in particular."""
    out = bytearray(data)
    for _ in range(1 << rng.randrange(4)):
        rng.choice(_EDITS)(rng, out, others)
    return bytes(out[: 1 << 16])


def shake_text(words: Sequence[bytes], rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes text, in which some words mean something."""
    if rng.random() < 0.5:
        return shake(rng, data, others)
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(words) * rng.choice((1, 1, 1, 2, 40)) + data[at:]


def shake_message(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes a message's header, a field of it or the body; its prefix has the true lengths."""
    if rng.random() < 0.2 or len(data) < PREFIX.size:
        return shake(rng, data, others)
    magic, version, kind, header_len, _ = PREFIX.unpack_from(data)
    header, body = data[PREFIX.size :][:header_len], data[PREFIX.size :][header_len:]
    choice = rng.random()
    if choice < 0.6:
        header = _with_another_field(rng, header)
    elif choice < 0.7:
        header = shake(rng, header, others)
    elif choice < 0.9:
        body = _with_other_numbers(rng, body)
    else:
        body = shake(rng, body, others)
    return PREFIX.pack(magic, version, kind, len(header), len(body)) + header + body


def shake_scan(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes the head of a payload or its sections, whose lengths stay true."""
    found = _sections(data)
    if found is None or rng.random() < 0.1:
        return shake(rng, data, others)
    head, sections = found
    for _ in range(rng.choice((1, 1, 2, 3))):
        choice = rng.random()
        if choice < 0.3 or not sections:
            _change_head(rng, head)
        elif choice < 0.4:
            _mix(rng, sections, others)
        else:
            n = rng.randrange(len(sections))
            sections[n] = _change_section(rng, sections[n], others)
    body = b"".join(struct.pack("<I", len(section)) + section for section in sections)
    head[9] = len(body)
    return SCAN_PREFIX.pack(*head) + body


def shake_scan_message(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes the payload within a message, or the message."""
    try:
        scan = decode(data, Scan)
    except ProtocolError:
        return shake_message(rng, data, others)
    if rng.random() < 0.2:
        return shake_message(rng, data, others)
    payload = shake_scan(rng, scan.payload.tobytes(), ())
    return encode(scan.model_copy(update={"payload": np.frombuffer(payload, np.uint8)}))


def shake_parts(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes one of the parts of a recording; its truth is messages behind their lengths."""
    about, ranges, truth = split_parts(data, 3)
    choice = rng.random()
    if choice < 0.3:
        about = shake(rng, about, ())
    elif choice < 0.6:  # mostly the header, which is text
        ranges = shake(rng, ranges[:128], ()) + ranges[128:]
    elif choice < 0.7 or len(truth) < 4:
        truth = shake(rng, truth, ())
    else:
        end = 4 + int.from_bytes(truth[:4], "little")
        first = shake_message(rng, truth[4:end], ())
        truth = len(first).to_bytes(4, "little") + first + truth[end:]
    return join_parts([about, ranges, truth])


def split_parts(data: bytes, count: int) -> list[bytes]:
    """Returns so many parts, each behind its length; what is missing is empty."""
    parts, at = [], 0
    for _ in range(count):
        end = at + 4 + int.from_bytes(data[at : at + 4], "little")
        parts.append(data[at + 4 : end])
        at = min(end, len(data))
    return parts


def join_parts(parts: Sequence[bytes]) -> bytes:
    """Reverses `split_parts`."""
    return b"".join(len(part).to_bytes(4, "little") + part for part in parts)


def _flip(rng: Random, out: bytearray, _: Sequence[bytes]) -> None:
    if out:
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)


def _set(rng: Random, out: bytearray, _: Sequence[bytes]) -> None:
    if out:
        out[rng.randrange(len(out))] = rng.randrange(256)


def _set_edge(rng: Random, out: bytearray, _: Sequence[bytes]) -> None:
    edge = rng.choice(_EDGE_BYTES)
    at = rng.randrange(len(out) + 1)
    out[at : at + len(edge)] = edge


def _erase(rng: Random, out: bytearray, _: Sequence[bytes]) -> None:
    at = rng.randrange(len(out) + 1)
    del out[at : at + (1 << rng.randrange(7))]


def _repeat(rng: Random, out: bytearray, _: Sequence[bytes]) -> None:
    at, to = rng.randrange(len(out) + 1), rng.randrange(len(out) + 1)
    out[to:to] = out[at : at + (1 << rng.randrange(7))] * rng.choice((1, 1, 2, 30))


def _insert(rng: Random, out: bytearray, _: Sequence[bytes]) -> None:
    at = rng.randrange(len(out) + 1)
    out[at:at] = rng.randbytes(1 << rng.randrange(5))


def _cut(rng: Random, out: bytearray, _: Sequence[bytes]) -> None:
    del out[rng.randrange(len(out) + 1) :]


def _splice(rng: Random, out: bytearray, others: Sequence[bytes]) -> None:
    if others:
        other = rng.choice(others)
        out[rng.randrange(len(out) + 1) :] = other[rng.randrange(len(other) + 1) :]


_EDITS = (_flip, _flip, _set, _set, _set_edge, _erase, _repeat, _insert, _cut, _splice)


def _with_another_field(rng: Random, header: bytes) -> bytes:
    unpacker = msgpack.Unpacker(strict_map_key=False)
    unpacker.feed(header)
    try:
        fields = unpacker.unpack()
        places = list(_places(fields))
        holder, key = rng.choice(places)
        choice = rng.random()
        if choice < 0.6:
            holder[key] = rng.choice(_HEAVY if rng.random() < _HEAVY_SHARE else _EVIL)
        elif choice < 0.7:
            del holder[key]
        elif choice < 0.8:
            other, other_key = rng.choice(places)
            holder[key] = other[other_key]
        elif isinstance(holder, list):
            holder.extend([holder[key]] * (4097 if rng.random() < _HEAVY_SHARE else 1))
        else:
            holder[rng.choice(("", "a", "é", 1, b"\xff"))] = holder[key]
        packed: bytes = msgpack.packb(fields)
    except (ValueError, LookupError, TypeError, msgpack.UnpackException):
        return shake(rng, header, ())
    return packed + b"\xc0" * (-(PREFIX.size + len(packed)) % 8)


def _places(value: Any, depth: int = 0) -> list[tuple[Any, Any]]:
    """Returns all pairs of a list or map and one of its keys, as far down as matters."""
    if depth > 6 or not isinstance(value, dict | list):
        return []
    keys = list(value) if isinstance(value, dict) else range(min(len(value), 20))
    places = [(value, key) for key in keys]
    for key in keys:
        places += _places(value[key], depth + 1)
    return places


def _with_other_numbers(rng: Random, body: bytes) -> bytes:
    out = bytearray(body)
    for _ in range(rng.choice((1, 2, 8))):
        at = rng.randrange(len(out) // 4 + 1) * 4
        edge = rng.choice(_EDGE_BYTES)
        out[at : at + len(edge)] = edge
    return bytes(out[: len(body)])


def _sections(data: bytes) -> tuple[list[Any], list[bytes]] | None:
    if len(data) < SCAN_PREFIX.size:
        return None
    sections, at = [], SCAN_PREFIX.size
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "little")
        sections.append(data[at + 4 : at + 4 + length])
        at += 4 + length
    return list(SCAN_PREFIX.unpack_from(data)), sections


def _change_head(rng: Random, head: list[Any]) -> None:
    """Changes form, flags, channels, columns, points, field of view or step."""
    n = rng.randrange(1, 9)
    if n in (6, 7, 8):
        wide = (*_FLOATS, 90.0, -90.0, 40.0, 1e-6, 0.01)
        head[n] = min(max(rng.choice(wide), -3e38), 3e38) if n < 8 else rng.choice(wide)
        return
    most = {1: 255, 2: 255, 3: 65_535, 4: 0xFFFFFFFF, 5: 0xFFFFFFFF}[n]
    nearby = head[n] + rng.choice((-8, -4, -1, 1, 4, 8))
    changed = rng.choice((nearby, nearby, rng.choice(_EDGES), rng.choice(_LARGE)))
    if n == 1:
        changed = rng.randrange(8)
    head[n] = min(max(changed, 0), most)


def _mix(rng: Random, sections: list[bytes], others: Sequence[bytes]) -> None:
    n = rng.randrange(len(sections))
    found = _sections(rng.choice(others)) if others else None
    choice = rng.random()
    if found and n < len(found[1]) and choice < 0.6:
        sections[n] = found[1][n]
    elif choice < 0.75:
        del sections[n]
    elif choice < 0.9:
        sections.insert(n, sections[rng.randrange(len(sections))])
    else:
        sections[n] = b""


def _change_section(rng: Random, section: bytes, others: Sequence[bytes]) -> bytes:
    if section.startswith(_ZSTD) and rng.random() < 0.7:
        return _change_frame(rng, section)
    choice = rng.random()
    if choice < 0.5:  # no length changes: what reads it goes deeper
        out = bytearray(section)
        for _ in range(rng.choice((1, 1, 2, 4, 16))):
            rng.choice((_flip, _set))(rng, out, ())
        return bytes(out)
    if choice < 0.65:  # other words
        at = rng.randrange(len(section) // 4 + 1) * 4
        return section[:at] + rng.randbytes(len(section) - at)
    if choice < 0.8:  # more or fewer words
        whole = section[: rng.randrange(len(section) // 4 + 1) * 4]
        return whole if rng.random() < 0.5 else section + whole
    return shake(rng, section, others)


def _change_frame(rng: Random, frame: bytes) -> bytes:
    """Changes what a zstd frame holds, or makes it one that holds much more."""
    try:
        raw = zstandard.ZstdDecompressor().decompressobj().decompress(frame)
    except zstandard.ZstdError:
        return frame
    if rng.random() < 0.1:
        return zstandard.ZstdCompressor(level=1).compress(bytes(rng.choice((0, 1, _MOST_RAW))))
    out = bytearray(raw)
    for _ in range(rng.choice((1, 2, 16))):
        rng.choice((_flip, _set))(rng, out, ())
    return zstandard.ZstdCompressor(level=1).compress(bytes(out))
