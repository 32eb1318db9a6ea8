"""The records of an MCAP file one after another, as far as they are whole.

What a file claims is held against its size and against limits before anything is allocated. A file
that was cut off or damaged ends where its records can no longer be followed.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, TypeAlias

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Message, Metadata

from protocol.limits import MAX_BODY_BYTES

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 2 * MAX_BODY_BYTES  # one that is nearly full takes one more message
MAX_RECORD_BYTES = 4 * MAX_BODY_BYTES
_FRAME = struct.Struct("<BQ")  # opcode, length
_FOOTER = struct.Struct("<BQQQI8s")  # opcode, length, summary, its offsets, its crc, magic
_ODD = (McapError, struct.error, ValueError, OverflowError, zstandard.ZstdError)
Record: TypeAlias = Attachment | Channel | DataEnd | Message | Metadata


class DamageError(Exception):
    """A record, or what is in it, is not what it claims."""


def is_complete(file: IO[bytes]) -> bool:
    """Whether the file has its end: it was closed, and not cut off since."""
    size = file.seek(0, os.SEEK_END)
    if size < len(MAGIC) + _FOOTER.size:
        return False
    file.seek(-_FOOTER.size, os.SEEK_END)
    opcode, length, *_, magic = _FOOTER.unpack(file.read(_FOOTER.size))
    return (opcode, length, magic) == (Opcode.FOOTER, 20, MAGIC)


def read_records(path: Path) -> Iterator[Record | DamageError]:
    """Yields what the data section holds, chunks opened, and in the place of what is damaged why.

    Of a chunk all comes or nothing does. `DataEnd` is the last, unless the file was cut off.
    """
    with path.open("rb") as file:
        for opcode, content in _frames(file):
            try:
                yield from _parse(opcode, content)
            except DamageError as error:
                yield error


def _frames(file: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yields opcode and content of each record up to the end of the data, if that is there."""
    file.seek(len(MAGIC))
    while len(frame := file.read(_FRAME.size)) == _FRAME.size:
        opcode, length = _FRAME.unpack(frame)
        left = os.fstat(file.fileno()).st_size - file.tell()
        if length > min(MAX_RECORD_BYTES, left):
            return
        yield opcode, file.read(length)
        if opcode == Opcode.DATA_END:
            return


def _parse(opcode: int, content: bytes) -> list[Record]:
    try:
        if opcode == Opcode.CHUNK:
            return list(_opened(Chunk.read(ReadDataStream(BytesIO(content)))))
        found = _single(opcode, content)
    except _ODD as error:
        raise DamageError(f"record of kind {opcode}: {error or type(error).__name__}") from None
    return [] if found is None else [found]


def _opened(chunk: Chunk) -> Iterator[Record]:
    data = _unpacked(chunk)
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise DamageError("a chunk's checksum is wrong")
    at = 0
    while at < len(data):
        opcode, length = _FRAME.unpack_from(data, at)
        at += _FRAME.size
        if length > len(data) - at:
            raise DamageError(f"a record in a chunk claims {length} bytes, {len(data) - at} left")
        if (found := _single(opcode, data[at : at + length])) is not None:
            yield found
        at += length


def _unpacked(chunk: Chunk) -> bytes:
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise DamageError(f"a chunk claims {size} bytes, limit {MAX_CHUNK_BYTES}")
    data: bytes
    if chunk.compression == "":
        data = chunk.data
    elif chunk.compression == "zstd":
        opener = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        with opener.stream_reader(chunk.data) as reader:
            data = reader.read(size + 1)
    else:
        raise DamageError(f"a chunk is compressed by {chunk.compression!r:.20}, not by zstd")
    if len(data) != size:
        raise DamageError(f"a chunk holds {len(data)} bytes, it claims {size}")
    return data


def _single(opcode: int, content: bytes) -> Record | None:
    """Returns the record, None for one of a kind that says nothing here."""
    stream = ReadDataStream(BytesIO(content))
    found: Record | None = None
    if opcode == Opcode.MESSAGE:
        found = Message.read(stream, len(content))
    elif opcode == Opcode.CHANNEL:
        found = Channel.read(stream)
    elif opcode == Opcode.ATTACHMENT:
        found = Attachment.read(stream)
    elif opcode == Opcode.METADATA:
        found = Metadata.read(stream)
    elif opcode == Opcode.DATA_END:
        found = DataEnd.read(stream)
    return found
