"""The reading side: a tape, whole, cut off or still being written."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from mcap.records import Attachment, Channel, DataEnd, Message, Metadata

from protocol.config import is_file, is_folder
from protocol.errors import ConfigError, ProtocolError
from protocol.inbox import Envelope, Inbox, RawMessage
from protocol.messages import Setup
from protocol.topics import TOPICS, Topic
from protocol.wire import decode
from tape.names import ENCODING, FACTS, GOES_ON_FROM, SETUP, STEM, TOPIC, files_in
from tape.records import MAGIC, DamageError, Record, is_complete, read_records


class Tape:
    """What was heard in a run.

    `files` are read in their order: a run has several if its tape was started again or grew long.
    `drops` counts, by reason, what could not be read so far.
    """

    def __init__(self, path: Path) -> None:
        """Opens a file and those in which it goes on, or all of a run folder.

        Raises:
            ConfigError: it is no tape, or its beginning is damaged.
        """
        self.path = path
        self.files = _files(path)
        self.drops: Counter[str] = Counter()
        ends = [_has_end(file) for file in self.files]
        self.is_whole = all(ends)
        """Whether each file was closed, and nothing in what was read so far is damaged."""
        self.facts: dict[str, str] = {}
        self.setup = self._read_setup()

    def heard(self, topics: Iterable[str] | None = None) -> Iterator[Envelope]:
        """Yields the messages of these topics, or of all, in the order in which they came.

        `received_ns` is that of the process that taped. All that is in complete chunks comes; what
        cannot be read is left out and counted in `drops`.

        Raises:
            ConfigError: a file cannot be read.
        """
        wanted = frozenset(TOPICS if topics is None else topics)
        for file in self.files:
            yield from self._heard_in(file, wanted)

    def _heard_in(self, file: Path, wanted: frozenset[str]) -> Iterator[Envelope]:
        channels: dict[int, tuple[Topic, str] | None] = {}
        inbox = Inbox()  # checks what comes off a tape as what comes off a bus
        is_cut = True
        try:
            for record in _records(file):
                if isinstance(record, Channel):
                    channels[record.id] = _native(record, wanted)
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
        """Returns the first that there is: one who was killed at once had no time to write it."""
        for file in self.files:
            facts, setup = _beginning(file)
            self.facts = facts or self.facts
            if setup is not None:
                return _setup(setup, file)
        raise ConfigError(
            f"{self.files[0]} is no tape of cpnet: it does not begin with {SETUP}, or was cut off "
            "before the end of that"
        )


def _beginning(file: Path) -> tuple[dict[str, str], bytes | None]:
    """Returns what a file says of itself before its messages: facts, and the setup as it is."""
    facts: dict[str, str] = {}
    for record in _records(file):
        if isinstance(record, Metadata) and record.name == FACTS:
            facts = dict(record.metadata)
        elif isinstance(record, Attachment) and record.name == SETUP:
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
                f"{path} has no tape: no {STEM}.mcap in it; `cpnet up --record` makes one"
                + (f". There is {others}: give the file" if others else "")
            )
        return found
    if not is_file(path):
        raise ConfigError(f"{path}: there is no such tape, neither a file nor a run folder")
    return [path, *_sequels(path)]


def _sequels(path: Path) -> list[Path]:
    """Returns the files in which a tape went on when one had grown long."""
    found, last = [], path
    for file in files_in(path.parent, path.stem):
        if file != path and _beginning(file)[0].get(GOES_ON_FROM) == last.name:
            found.append(file)
            last = file
    return found


def _has_end(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            if not MAGIC.startswith(file.read(len(MAGIC))):  # a new one may be empty
                raise ConfigError(f"{path} is no tape: it does not begin as an MCAP file does")
            return is_complete(file)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None


def _native(channel: Channel, wanted: frozenset[str]) -> tuple[Topic, str] | None:
    """Returns topic and key of a channel, None if nobody wants it or it is for other tools."""
    name = channel.metadata.get(TOPIC, "")
    if channel.message_encoding != ENCODING or name not in wanted or name not in TOPICS:
        return None
    return TOPICS[name], channel.topic
