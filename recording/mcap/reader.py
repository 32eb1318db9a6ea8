"""Reads an MCAP recording, complete, cut off or still being written.

What a file claims is checked against its size and against limits before anything is allocated. A
file that was cut off or damaged ends where its records can no longer be followed.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, TypeAlias

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Message, Metadata

from protocol.config import is_file, is_folder
from protocol.errors import ConfigError, ProtocolError
from protocol.inbox import Envelope, Inbox, RawMessage
from protocol.messages import Setup
from protocol.topics import TOPICS, Topic
from protocol.wire import decode
from recording.limits import MAX_CHUNK_BYTES, MAX_RECORD_BYTES
from recording.mcap.format import (
    ENCODING,
    PREVIOUS_FILE,
    RUN_METADATA,
    SETUP_ATTACHMENT,
    STEM,
    TOPIC,
    files_in,
)

MAGIC = b"\x89MCAP0\r\n"
_FRAME = struct.Struct("<BQ")  # opcode, length
_FOOTER = struct.Struct("<BQQQI8s")  # opcode, length, summary, its offsets, its crc, magic
_PARSE_ERRORS = (McapError, struct.error, ValueError, OverflowError, zstandard.ZstdError)
Record: TypeAlias = Attachment | Channel | DataEnd | Message | Metadata


class DamageError(Exception):
    """A record, or its content, is damaged."""


def is_complete(file: IO[bytes]) -> bool:
    """Whether the file has its end: it was closed, and not cut off since."""
    size = file.seek(0, os.SEEK_END)
    if size < len(MAGIC) + _FOOTER.size:
        return False
    file.seek(-_FOOTER.size, os.SEEK_END)
    opcode, length, *_, magic = _FOOTER.unpack(file.read(_FOOTER.size))
    return (opcode, length, magic) == (Opcode.FOOTER, 20, MAGIC)


def read_records(path: Path) -> Iterator[Record | DamageError]:
    """Yields the records of the data section and its chunks, and an error for each damaged one.

    A chunk is yielded completely or not at all. `DataEnd` is the last, unless the file was cut off.
    """
    with path.open("rb") as file:
        for opcode, content in _frames(file):
            try:
                yield from _parse(opcode, content)
            except DamageError as error:
                yield error


def _frames(file: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yields opcode and content of each record up to the end of the data, if the file has one."""
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
            return list(_chunk_records(Chunk.read(ReadDataStream(BytesIO(content)))))
        found = _single(opcode, content)
    except _PARSE_ERRORS as error:
        raise DamageError(f"record of kind {opcode}: {error or type(error).__name__}") from None
    return [] if found is None else [found]


def _chunk_records(chunk: Chunk) -> Iterator[Record]:
    data = _decompressed(chunk)
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


def _decompressed(chunk: Chunk) -> bytes:
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
    """Returns the record, None for one of a kind that is not needed."""
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


class McapReader:
    """The recorded messages of a run.

    `files` are read in order: a run has several if the recorder was restarted or the file grew.
    `drops` counts, by reason, what could not be read so far.
    """

    def __init__(self, path: Path) -> None:
        """Opens a file and its continuation files, or all of a run folder.

        Raises:
            ConfigError: it is no recording, or its beginning is damaged.
        """
        self.path = path
        self.files = _files(path)
        self.drops: Counter[str] = Counter()
        ends = [_has_end(file) for file in self.files]
        self.is_whole = all(ends)
        """Whether each file was closed, and nothing in what was read so far is damaged."""
        self.facts: dict[str, str] = {}
        self.setup = self._read_setup()

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[Envelope]:
        """Yields the messages of these topics, or of all, in the order in which they came.

        `received_ns` is that of the recording process. All complete chunks are read; unreadable
        parts are left out and counted in `drops`.

        Raises:
            ConfigError: a file cannot be read.
        """
        wanted = frozenset(TOPICS if topics is None else topics)
        for file in self.files:
            yield from self._messages_in(file, wanted)

    def _messages_in(self, file: Path, wanted: frozenset[str]) -> Iterator[Envelope]:
        channels: dict[int, tuple[Topic, str] | None] = {}
        inbox = Inbox()  # checks recorded messages as those from a bus
        is_cut = True
        try:
            for record in _records(file):
                if isinstance(record, Channel):
                    channels[record.id] = _topic_and_key(record, wanted)
                elif isinstance(record, Message) and record.channel_id in channels:
                    if (channel := channels[record.channel_id]) is not None:
                        inbox.put(RawMessage(*channel, record.data, record.log_time))
                        item = inbox.get()
                        if isinstance(item, Envelope):
                            yield item
                elif isinstance(record, Message):
                    self.drops["unknown_channel"] += 1
                elif isinstance(record, DamageError):
                    self.drops["damaged"] += 1
                    self.is_whole = False
                elif isinstance(record, DataEnd):
                    is_cut = False
        finally:
            self.drops += inbox.drops
        self.is_whole = self.is_whole and not is_cut

    def _read_setup(self) -> Setup:
        """Returns the first setup found: a recorder that was killed early may have written none."""
        for file in self.files:
            facts, setup = _read_header(file)
            self.facts = facts or self.facts
            if setup is not None:
                return _setup(setup, file)
        raise ConfigError(
            f"{self.files[0]} is no recording of cpnet: it does not begin with {SETUP_ATTACHMENT}, "
            "or was cut off before the end of that"
        )


def _read_header(file: Path) -> tuple[dict[str, str], bytes | None]:
    """Returns the header of a file, before its messages: facts, and the encoded setup."""
    facts: dict[str, str] = {}
    for record in _records(file):
        if isinstance(record, Metadata) and record.name == RUN_METADATA:
            facts = dict(record.metadata)
        elif isinstance(record, Attachment) and record.name == SETUP_ATTACHMENT:
            return facts, record.data
        elif isinstance(record, Message | DamageError):
            break
    return facts, None


def _records(file: Path) -> Iterator[Record | DamageError]:
    try:
        yield from read_records(file)
    except OSError as error:
        raise ConfigError(f"{file} cannot be read: {error}") from None


def _setup(data: bytes, file: Path) -> Setup:
    try:
        return decode(data, Setup)
    except ProtocolError as error:
        raise ConfigError(f"{file}: the setup in it cannot be read: {error}") from None


def _files(path: Path) -> list[Path]:
    if is_folder(path):
        found = files_in(path)
        if not found:
            others = ", ".join(sorted(file.name for file in path.glob("*.mcap"))[:8])
            raise ConfigError(
                f"{path} has no recording: no {STEM}.mcap in it; `cpnet up --record` makes one"
                + (f". There is {others}: give the file" if others else "")
            )
        return found
    if not is_file(path):
        raise ConfigError(f"{path}: there is no such recording, neither a file nor a run folder")
    return [path, *_continuation_files(path)]


def _continuation_files(path: Path) -> list[Path]:
    """Returns the continuation files of a recording."""
    found, last = [], path
    for file in files_in(path.parent, path.stem):
        if file != path and _read_header(file)[0].get(PREVIOUS_FILE) == last.name:
            found.append(file)
            last = file
    return found


def _has_end(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            if not MAGIC.startswith(file.read(len(MAGIC))):  # a new one may be empty
                raise ConfigError(f"{path} is no recording: it does not begin as an MCAP file does")
            return is_complete(file)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None


def _topic_and_key(channel: Channel, wanted: frozenset[str]) -> tuple[Topic, str] | None:
    """Returns topic and key of a channel, None if it is not wanted or for other tools."""
    name = channel.metadata.get(TOPIC, "")
    if channel.message_encoding != ENCODING or name not in wanted or name not in TOPICS:
        return None
    return TOPICS[name], channel.topic
