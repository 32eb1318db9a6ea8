"""Writes an MCAP recording: every message as received, on one channel per key.

Chunks are small, so that a killed process loses about a second.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from protocol.errors import ConfigError, CpnetError, MessageError
from protocol.inbox import Envelope
from protocol.messages import Setup
from protocol.topics import TOPICS
from protocol.version import own_version
from protocol.wire import encode, peek_frame_time
from recording.limits import MAX_CHANNELS, MAX_CHUNKS
from recording.mcap.format import (
    CLOSING_METADATA,
    ENCODING,
    PREVIOUS_FILE,
    RUN_METADATA,
    SETUP_ATTACHMENT,
    SETUP_TYPE,
    TOPIC,
    name_of,
    schema_of,
)
from recording.mcap.format import SCHEMA_ENCODING as SCHEMA_ENCODING
from recording.mcap.foxglove_messages import Shape

CHUNK_BYTES = 256 << 10
CHUNK_NS = 700_000_000  # then a chunk is closed, however small it is
_NEVER_BYTES = 1 << 62


class McapFile:
    """One MCAP file; messages older than a second are in it, if `settle` is called often."""

    def __init__(self, path: Path, setup: bytes, facts: dict[str, str]) -> None:
        """Starts a file with the run's facts, and its setup.

        Raises:
            ConfigError: the file is there already or cannot be written.
        """
        self.path = path
        self._counts: dict[int, int] = {}
        self._log_ns = 0
        self._began_ns = 0
        self._waiting_bytes = 0
        self._chunks = 0
        self._is_closed = False
        self.size_bytes = 0
        try:
            self._file = path.open("xb")
        except OSError as error:
            raise ConfigError(f"{path} cannot be written: {error.strerror or error}") from None
        # Chunks end here and not in the library, so that each is in the file as soon as it ends.
        self._writer = Writer(self._file, _NEVER_BYTES, CompressionType.ZSTD)
        with self._named_faults():
            self._writer.start(library=f"cpnet {own_version()}")
            self._writer.add_metadata(RUN_METADATA, facts)
            self._writer.add_attachment(0, 0, SETUP_ATTACHMENT, SETUP_TYPE, setup)
            self._writer.flush()

    @property
    def is_full(self) -> bool:
        """Whether a continuation file should start: the index of this one takes much memory."""
        return len(self._counts) >= MAX_CHANNELS or self._chunks >= MAX_CHUNKS

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Returns the number of a new schema."""
        number: int = self._writer.register_schema(name, encoding, data)
        return number

    def channel(self, topic: str, encoding: str, schema: int, facts: dict[str, str]) -> int:
        """Returns the number of a new channel."""
        number: int = self._writer.register_channel(topic, encoding, schema, facts)
        self._counts[number] = 0
        return number

    def write(self, channel: int, data: bytes, log_ns: int, sim_time_ns: int | None) -> None:
        """Adds a message; its log time is never before that of an earlier one.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        self._log_ns = max(self._log_ns, log_ns)
        if not self._waiting_bytes:
            self._began_ns = self._log_ns
        count = self._counts[channel]
        self._counts[channel] = (count + 1) & 0xFFFFFFFF
        published_ns = self._log_ns if sim_time_ns is None or sim_time_ns < 0 else sim_time_ns
        self._writer.add_message(channel, self._log_ns, data, published_ns, count)
        self._waiting_bytes += len(data)
        if self._waiting_bytes >= CHUNK_BYTES:
            self._end_chunk()

    def settle(self, now_ns: int) -> None:
        """Ends the chunk if it is old.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        if self._waiting_bytes and now_ns - self._began_ns >= CHUNK_NS:
            self._end_chunk()

    def close(self, facts: dict[str, str]) -> None:
        """Writes the outcome, the index and the end, unless that was done or the disk failed.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        if self._is_closed:
            return
        self._is_closed = True
        with self._named_faults():
            self._writer.flush()
            self._writer.add_metadata(CLOSING_METADATA, facts)
            self._writer.finish()
            self.size_bytes = self._file.tell()
            self._file.close()

    def _end_chunk(self) -> None:
        self._waiting_bytes = 0
        self._chunks += 1
        with self._named_faults():
            self._writer.flush()
        self.size_bytes = self._file.tell()

    @contextlib.contextmanager
    def _named_faults(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._is_closed = True
            with contextlib.suppress(OSError):
                self._file.close()
            raise CpnetError(f"{self.path} cannot be written: {error.strerror or error}") from None


_PROTOBUF = "protobuf"


class McapWriter:
    """Writes a recording in one or more files: the next starts when the index has grown large.

    `messages` counts the native ones. `files` are all that were started.
    """

    def __init__(self, next_path: Callable[[], Path], setup: Setup, facts: dict[str, str]) -> None:
        """Starts the first file.

        Args:
            next_path: says where a new file is to be.
            setup: the run's setup message.
            facts: further facts of the run for readers.

        Raises:
            ConfigError: the file is there already or cannot be written.
        """
        self._next_path = next_path
        self._setup = encode(setup)
        self._facts = facts
        self._ended_bytes = 0
        self.messages = 0
        self.files: list[Path] = []
        self._file = self._open()

    @property
    def size_bytes(self) -> int:
        """Total size of the files."""
        return self._ended_bytes + self._file.size_bytes

    def write(self, item: Envelope) -> None:
        """Adds a message as it was received.

        Raises:
            ProtocolError: it has no key, or its bytes cannot be decoded.
            CpnetError: the disk is full, or fails.
        """
        sim_time_ns = peek_frame_time(item.data, TOPICS[item.topic].message).sim_time_ns
        place = (item.topic, *item.parts.values())
        channel = self._channels.get(place)
        if channel is None:
            channel = self._channels[place] = self._native(item)
        self._file.write(channel, item.data, item.received_ns, sim_time_ns)
        self.messages += 1

    def write_shape(self, topic: str, shape: Shape, log_ns: int, sim_time_ns: int | None) -> None:
        """Adds a message for other tools, of this simulated time or of none.

        Its log time is never before that of an earlier message.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        place = (topic,)
        channel = self._channels.get(place)
        if channel is None:
            channel = self._channels[place] = self._foreign(topic, shape)
        self._file.write(channel, shape.SerializeToString(), log_ns, sim_time_ns)

    def settle(self, now_ns: int) -> None:
        """Writes buffered messages to the file in time; to be called many times a second.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        self._file.settle(now_ns)
        if self._file.is_full:
            self._file.close({})
            self._ended_bytes += self._file.size_bytes
            self._file = self._open()

    def close(self, facts: dict[str, str]) -> None:
        """Ends the last file; the facts are the outcome.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        self._file.close(facts)

    def _open(self) -> McapFile:
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, ...], int] = {}
        before = {PREVIOUS_FILE: self.files[-1].name} if self.files else {}
        file = McapFile(self._next_path(), self._setup, self._facts | before)
        self.files.append(file.path)
        return file

    def _native(self, item: Envelope) -> int:
        """Returns a new channel for messages of this key."""
        topic = TOPICS[item.topic]
        try:
            key = topic.key(**item.parts)
        except ValueError as error:
            raise MessageError(str(error)) from None
        name = name_of(topic.message)
        if name not in self._schemas:
            schema = schema_of(topic.message)
            self._schemas[name] = self._file.schema(name, SCHEMA_ENCODING, schema)
        facts = {TOPIC: topic.name, "bus": topic.bus.value}
        return self._file.channel(key, ENCODING, self._schemas[name], facts)

    def _foreign(self, topic: str, shape: Shape) -> int:
        """Returns a new channel for messages like this one."""
        name = shape.DESCRIPTOR.full_name
        if name not in self._schemas:
            described = build_file_descriptor_set(type(shape)).SerializeToString()
            self._schemas[name] = self._file.schema(name, _PROTOBUF, described)
        return self._file.channel(topic, _PROTOBUF, self._schemas[name], {})
