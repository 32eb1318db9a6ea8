"""Records both buses into MCAP files."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from protocol.inbox import Envelope, Inbox, Presence
from protocol.messages import End, Setup
from protocol.observer import ALL_TOPICS, lower_priority
from protocol.process import Context
from protocol.topics import TOPICS, BusName
from protocol.version import own_version
from recording.mcap.format import next_file
from recording.mcap.writer import McapWriter

PATIENCE_NS = 4_000_000_000
SILENCE_NS = 150_000_000


class EndOfRecording:
    """Detects the end of a run: while the record process is present, more messages may come."""

    def __init__(self) -> None:
        self._ended_ns: int | None = None
        self._left_ns: int | None = None
        self._received_ns = 0
        self._recorders: set[tuple[str, BusName]] = set()

    def look(self, presence: Presence, now_ns: int) -> None:
        """Handles a process that appeared or left; without a world no messages are expected.

        On the V2X bus all are gone for a moment when the edge dies, which hosts it.
        """
        if presence.role == "record":
            one = presence.id, presence.bus
            (self._recorders.add if presence.alive else self._recorders.discard)(one)
        elif presence.role == "sim" and presence.bus is BusName.WORLD:
            self._left_ns = None if presence.alive else now_ns

    def begin(self, now_ns: int) -> None:
        """Handles the end of the world."""
        self._ended_ns = now_ns if self._ended_ns is None else self._ended_ns

    def received(self, now_ns: int) -> None:
        """Registers that a message arrived."""
        self._received_ns = now_ns

    def is_over(self, now_ns: int) -> bool:
        """Whether no more messages are expected, or the timeout is over."""
        began_ns = self._left_ns if self._ended_ns is None else self._ended_ns
        if began_ns is None:
            return False
        is_silent = not self._recorders and now_ns - self._received_ns >= SILENCE_NS
        return is_silent or now_ns - began_ns >= PATIENCE_NS


POLL_S = 0.2
"""Pause between polls of the inbox: messages are handled in batches, for less work."""
TRUTH_TOPICS = frozenset({"truth", "sighting"})


def recorded_topics(*, truth: bool) -> frozenset[str]:
    """Returns the names of the topics that are recorded, with the truth or without."""
    return ALL_TOPICS if truth else ALL_TOPICS - TRUTH_TOPICS


class McapRecorder:
    """Records all received messages; a role, see `protocol.process.Role`."""

    def __init__(
        self,
        setup: Setup,
        next_path: Callable[[], Path],
        inbox: Inbox,
        stop: threading.Event,
        *,
        truth: bool,
    ) -> None:
        """Starts a recording, with the truth or without; `stop` is set once the run is over.

        Raises:
            ConfigError: the recording cannot be written there.
        """
        inbox.keep_encoded()
        self._inbox = inbox
        self._stop = stop
        self._ending = EndOfRecording()
        self._reason = "unknown"
        self._drops: Counter[str] | None = None
        self.writer = McapWriter(next_path, setup, _facts(setup, truth=truth))

    @property
    def dropped(self) -> int:
        """Number of messages, until the end of the recording, that are not in it."""
        return (self._inbox.drops if self._drops is None else self._drops).total()

    def on(self, item: Envelope | Presence) -> None:
        """Records a message.

        Raises:
            ProtocolError: it cannot be recorded.
            CpnetError: the disk is full, or fails.
        """
        if isinstance(item, Presence):
            self._ending.look(item, time.monotonic_ns())
            return
        end = item.message if item.topic == "end" else None
        self.writer.write(item)
        self._ending.received(time.monotonic_ns())
        if isinstance(end, End):
            self._reason = end.reason
            self._ending.begin(time.monotonic_ns())

    def poll(self) -> None:
        """Writes due chunks; called when all received messages were handled.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        now_ns = time.monotonic_ns()
        self.writer.settle(now_ns)
        is_idle = self._inbox.is_empty
        if not is_idle:
            self._ending.received(now_ns)
        if self._ending.is_over(now_ns):
            self._stop.set()
        elif is_idle:
            time.sleep(POLL_S)

    def close(self) -> None:
        """Ends the recording.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        self._drops = Counter(self._inbox.drops)  # later drops do not count
        facts = {
            "end_reason": self._reason,
            "messages": str(self.writer.messages),
            "drops": json.dumps(self._drops),
        }
        self.writer.close(facts)


def _facts(setup: Setup, *, truth: bool) -> dict[str, str]:
    scenario = setup.scenario
    told = {key: str(scenario.get(key, "")) for key in ("name", "mode", "seed")}
    return told | {
        "cpnet": own_version(),
        "truth": json.dumps(truth),
        "log_time": "when it arrived, on time.monotonic_ns of the process that recorded",
        "publish_time": "simulated time; the log time where a message has none",
    }


def build(context: Context) -> McapRecorder:
    """Starts `run.mcap`, or the next of that name if it exists; announces that it is ready.

    Raises:
        ConfigError: the run folder cannot take it.
    """
    lower_priority()
    scenario = context.setup.scenario
    truth = bool(scenario.get("record", {}).get("truth", True))
    recorder = McapRecorder(
        context.setup, lambda: next_file(context.run_dir), context.inbox, context.stop, truth=truth
    )
    for name in sorted(recorded_topics(truth=truth)):
        topic = TOPICS[name]
        bus = context.world if topic.bus is BusName.WORLD else context.v2x
        bus.subscribe(name)
    context.world.watch()
    context.v2x.watch()
    context.announce("mcap")
    return recorder
