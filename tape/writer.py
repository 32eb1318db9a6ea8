"""The writing side: every message as it came, on a channel of its own for each key."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mcap_protobuf.schema import build_file_descriptor_set

from protocol.errors import MessageError
from protocol.inbox import Envelope
from protocol.messages import Setup
from protocol.topics import TOPICS
from protocol.wire import FrameTime, encode, peek_frame_time
from tape.names import ENCODING, GOES_ON_FROM, TOPIC
from tape.reel import Reel
from tape.schemas import ENCODING as SCHEMA_ENCODING
from tape.schemas import name_of, schema_of
from tape.shapes import Shape

_PROTOBUF = "protobuf"


class TapeWriter:
    """Writes one file after another: the next begins when the index of one has grown large.

    `messages` counts the native ones. `files` are all that were begun.
    """

    def __init__(self, next_path: Callable[[], Path], setup: Setup, facts: dict[str, str]) -> None:
        """Begins the first file.

        Args:
            next_path: says where a new file is to be.
            setup: what every process of the run was given.
            facts: what else readers are to know of the run.

        Raises:
            ConfigError: the file is there already or cannot be written.
        """
        self._next_path = next_path
        self._setup = encode(setup)
        self._facts = facts
        self._ended_bytes = 0
        self.messages = 0
        self.files: list[Path] = []
        self._reel = self._load()

    @property
    def size_bytes(self) -> int:
        """How much is in the files."""
        return self._ended_bytes + self._reel.size_bytes

    def write(self, item: Envelope) -> FrameTime:
        """Adds a message as it came; returns of which moment it is.

        Raises:
            ProtocolError: it has no key, or nobody could read its bytes.
            CpnetError: the disk is full, or fails.
        """
        moment = peek_frame_time(item.data, TOPICS[item.topic].message)
        place = (item.topic, *item.parts.values())
        channel = self._channels.get(place)
        if channel is None:
            channel = self._channels[place] = self._native(item)
        self._reel.write(channel, item.data, item.received_ns, moment.sim_time_ns)
        self.messages += 1
        return moment

    def write_shape(self, topic: str, shape: Shape, log_ns: int, sim_time_ns: int | None) -> None:
        """Adds a message for other tools, of this simulated time or of none.

        Its log time is later where something later is on the tape already.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        place = (topic,)
        channel = self._channels.get(place)
        if channel is None:
            channel = self._channels[place] = self._foreign(topic, shape)
        self._reel.write(channel, shape.SerializeToString(), log_ns, sim_time_ns)

    def settle(self, now_ns: int) -> None:
        """Sees to it that what came is in the file soon; to be called many times a second.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        self._reel.settle(now_ns)
        if self._reel.is_full:
            self._reel.close({})
            self._ended_bytes += self._reel.size_bytes
            self._reel = self._load()

    def close(self, facts: dict[str, str]) -> None:
        """Ends the last file; the facts say what came of it.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        self._reel.close(facts)

    def _load(self) -> Reel:
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, ...], int] = {}
        before = {GOES_ON_FROM: self.files[-1].name} if self.files else {}
        reel = Reel(self._next_path(), self._setup, self._facts | before)
        self.files.append(reel.path)
        return reel

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
            self._schemas[name] = self._reel.schema(name, SCHEMA_ENCODING, schema)
        facts = {TOPIC: topic.name, "bus": topic.bus.value}
        return self._reel.channel(key, ENCODING, self._schemas[name], facts)

    def _foreign(self, topic: str, shape: Shape) -> int:
        """Returns a new channel for messages like this one."""
        name = shape.DESCRIPTOR.full_name
        if name not in self._schemas:
            described = build_file_descriptor_set(type(shape)).SerializeToString()
            self._schemas[name] = self._reel.schema(name, _PROTOBUF, described)
        return self._reel.channel(topic, _PROTOBUF, self._schemas[name], {})
