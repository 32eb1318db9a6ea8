"""Wire format of messages: a fixed prefix, a msgpack header, then arrays padded to 8 bytes.

    prefix  magic "CPNT", u16 version, u16 kind, u32 header length, u32 body length
    header  msgpack map; an array field holds its shape
    body    the arrays' little-endian bytes, in the order in which the message declares them

Every length is checked against its limit and against the bytes received before anything is
allocated.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Any, NamedTuple, TypeVar

import msgpack
import numpy as np
from pydantic import ValidationError

from protocol.errors import MessageError, VersionError
from protocol.limits import MAX_BODY_BYTES, MAX_CONTAINERS, MAX_SHOWN_CHARS
from protocol.messages import MESSAGES, Message
from protocol.messages.fields import Array

VERSION = 4
MAGIC = b"CPNT"
PREFIX = struct.Struct("<4sHHII")
_ALIGN = 8
_ODD = (ValueError, msgpack.UnpackException, RecursionError, OverflowError)

M = TypeVar("M", bound=Message)


class FrameTime(NamedTuple):
    """The frame and the simulated time that a message bears; None where that is no integer."""

    frame: int | None = None
    sim_time_ns: int | None = None


def encode(message: Message) -> bytes:
    """Returns the message as bytes.

    Raises:
        MessageError: it is larger than a receiver would take.
    """
    fields = array_fields(type(message))
    header: dict[str, Any] = message.model_dump(exclude=set(fields))
    parts: list[bytes] = []
    for name in fields:
        array = getattr(message, name)
        header[name] = list(array.shape)
        parts += [array.tobytes(), bytes(-array.nbytes % _ALIGN)]
    packed: bytes = msgpack.packb(header)
    packed += b"\xc0" * (-(PREFIX.size + len(packed)) % _ALIGN)  # nil bytes after the map
    body = b"".join(parts)
    _check_limit("header", len(packed), message.max_header_bytes)
    _check_limit("body", len(body), MAX_BODY_BYTES)
    return PREFIX.pack(MAGIC, VERSION, message.kind, len(packed), len(body)) + packed + body


def decode(data: bytes, expected: type[M]) -> M:
    """Reads one message of the expected type; its arrays are read-only views of `data`.

    Fields that have a default may be missing: an older sender may not know them.

    Raises:
        VersionError: the sender speaks another version.
        MessageError: anything else that is wrong with the bytes.
    """
    header_len, body_len = _read_prefix(data, expected)
    header = _unpack(data[PREFIX.size : PREFIX.size + header_len])
    body_start = PREFIX.size + header_len
    end = body_start
    for name, spec in array_fields(expected).items():
        if name not in header and not expected.model_fields[name].is_required():
            continue
        header[name], end = _read_array(data, end, header.get(name), spec, name)
    if end != body_start + body_len:
        raise MessageError(f"body has {body_len} bytes, its arrays take {end - body_start}")
    try:
        return expected.model_validate(header)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(
            [expected.__name__, *(str(part)[:MAX_SHOWN_CHARS] for part in first["loc"])]
        )
        raise MessageError(f"{where}: {first['msg'][:MAX_SHOWN_CHARS]}") from None


def peek_frame_time(data: bytes, expected: type[Message]) -> FrameTime:
    """Reads only the frame and the simulated time of a message.

    Raises:
        VersionError: the sender speaks another version.
        MessageError: what was read is wrong.
    """
    header_len, _ = _read_prefix(data, expected)
    unpacker = _unpacker(data[PREFIX.size : PREFIX.size + header_len])
    wanted = _moment_fields(expected)
    found: dict[str, int | None] = {}
    try:
        left = unpacker.read_map_header()
        while left and len(found) < len(wanted):
            left -= 1
            name = unpacker.unpack()
            if name in wanted:
                value = unpacker.unpack()
                found[name] = value if type(value) is int else None
            else:
                unpacker.skip()
    except _ODD as error:
        raise MessageError(f"header is not msgpack: {error or type(error).__name__}") from None
    return FrameTime(**found)


@cache
def _moment_fields(message: type[Message]) -> tuple[str, ...]:
    return tuple(name for name in FrameTime._fields if name in message.model_fields)


@cache
def array_fields(message: type[Message]) -> dict[str, Array]:
    """Returns the array fields of a message type, in declaration order."""
    result = {}
    for name, field in message.model_fields.items():
        for mark in field.metadata:
            if isinstance(mark, Array):
                result[name] = mark
    return result


def _check_limit(what: str, length: int, limit: int) -> None:
    if length > limit:
        raise MessageError(f"{what} has length {length}, limit {limit}")


def _read_prefix(data: bytes, expected: type[Message]) -> tuple[int, int]:
    if len(data) < PREFIX.size:
        raise MessageError(f"message has {len(data)} bytes, the prefix alone takes {PREFIX.size}")
    magic, version, kind, header_len, body_len = PREFIX.unpack_from(data)
    if magic != MAGIC:
        raise MessageError(f"magic is {magic!r}, expected {MAGIC!r}")
    if version != VERSION:
        raise VersionError(f"sender speaks protocol version {version}, this side {VERSION}")
    if kind != expected.kind:
        name = MESSAGES[kind].__name__ if kind in MESSAGES else f"kind {kind}"
        raise MessageError(f"message is {name}, this topic carries {expected.__name__}")
    _check_limit("header", header_len, expected.max_header_bytes)
    _check_limit("body", body_len, MAX_BODY_BYTES)
    claimed = PREFIX.size + header_len + body_len
    if claimed != len(data):
        raise MessageError(f"message has {len(data)} bytes, its prefix says {claimed}")
    return header_len, body_len


def _unpacker(packed: bytes) -> msgpack.Unpacker:
    """Returns an unpacker that refuses a header that takes far more memory than its bytes."""
    room = MAX_CONTAINERS + len(packed) // 16

    def count(container: Any) -> Any:  # noqa: ANN401 - a list or a dict
        nonlocal room
        room -= 1
        if room < 0:
            raise ValueError("too many lists and maps")
        return container

    hook = count if len(packed) > room else None  # each takes a byte or more: few bytes hold few
    unpacker = msgpack.Unpacker(
        strict_map_key=True,
        max_buffer_size=len(packed) or 1,
        list_hook=hook,
        object_hook=hook,
        ext_hook=_refuse_extension,
        timestamp=1,  # a float, which costs least
    )
    unpacker.feed(packed)
    return unpacker


def _unpack(packed: bytes) -> dict[str, Any]:
    try:
        header = _unpacker(packed).unpack()
    except _ODD as error:
        raise MessageError(f"header is not msgpack: {error or type(error).__name__}") from None
    if not isinstance(header, dict):
        raise MessageError(f"header is a {type(header).__name__}, expected a map")
    return header


def _refuse_extension(code: int, data: bytes) -> None:
    raise ValueError(f"extension {code} of {len(data)} bytes")


def _read_array(
    data: bytes, start: int, claimed: object, spec: Array, name: str
) -> tuple[np.ndarray[Any, Any], int]:
    if not isinstance(claimed, list) or not all(type(n) is int and n >= 0 for n in claimed):
        raise MessageError(f"array {name} has no valid shape in the header: {claimed!r:.80}")
    shape = tuple(claimed)
    try:
        spec.check_shape(shape)
    except ValueError as error:
        raise MessageError(f"array {name}: {error}") from None
    size = spec.size_bytes(shape)
    end = start + size + (-size % _ALIGN)
    if end > len(data):
        raise MessageError(
            f"array {name} of shape {shape} needs {size} bytes, {len(data) - start} left"
        )
    count = size // np.dtype(spec.dtype).itemsize
    return np.frombuffer(data, spec.dtype, count, start).reshape(shape), end
