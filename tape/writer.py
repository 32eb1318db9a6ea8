"""The writing side: every message as it came, on a channel of its own for each key."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from protocol.errors import MessageError
from protocol.inbox import Envelope
from protocol.messages import Setup
from protocol.topics import TOPICS
from protocol.wire import encode
from tape.names import ENCODING, TOPIC
from tape.reel import Reel
from tape.schemas import ENCODING as SCHEMA_ENCODING
from tape.schemas import name_of, schema_of


class TapeWriter:
    """Writes one file after another: the next begins when the index of one has grown large."""

    def __init__(self, next_path: Callable[[], Path], setup: Setup, facts: dict[str, str]) -> None:
        """Begins the first file.

        Args:
            next_path: says where a new file is to be.
            setup: what every process of the run was given.
            facts: what else is to be known of the run, for its readers.

        Raises:
            ConfigError: the file cannot be written.
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
        """How much was written so far."""
        return self._ended_bytes + self._reel.size_bytes

    def write(self, item: Envelope) -> None:
        """Adds a message as it came.

        Raises:
            MessageError: its key has no place in the topic table.
            CpnetError: the disk is full, or fails.
        """
        place = (item.topic, *item.parts.values())
        channel = self._channels.get(place)
        if channel is None:
            channel = self._channels[place] = self._add_channel(item)
        sim_time_ns = getattr(item.message, "sim_time_ns", None)
        self._reel.write(channel, item.data, item.received_ns, sim_time_ns)
        self.messages += 1

    def settle(self, now_ns: int) -> None:
        """To be called many times a second: sees to it that what came is in the file soon.

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
        reel = Reel(self._next_path(), self._setup, self._facts)
        self.files.append(reel.path)
        return reel

    def _add_channel(self, item: Envelope) -> int:
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
