"""Observers of a run: they attach to both buses and publish nothing.

An observer attaches and detaches at any time; no process waits for it, except for a recording on
the same machine. `FrameBuffer` keeps the messages of the newest frames undecoded.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

from protocol.bus import CONNECT_TIMEOUT_MS, Endpoint, ZenohBus, open_bus
from protocol.errors import BusError, ProtocolError
from protocol.inbox import Envelope, Inbox, Presence
from protocol.messages import Message, Setup
from protocol.topics import QUERIED, TOPICS, BusName

ALL_TOPICS = frozenset(TOPICS) - QUERIED
NICE = 10  # a tenth of the share of a process at 0 that wants the same core
_ASK_S = 2.0
_CLOSE_S = 1.0
_POLL_S = 0.1

T = TypeVar("T")


def lower_priority() -> None:
    """Leaves most of a busy core to others: the calling thread's nice value becomes `NICE` or more.

    Real-time priority ends. Not as idle work (SCHED_IDLE): where all cores are busy that hardly
    runs, and while it holds the interpreter's lock, Zenoh's threads of this process wait for it,
    and publishers for them.
    """
    if os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.setpriority(os.PRIO_PROCESS, 0, max(os.getpriority(os.PRIO_PROCESS, 0), NICE))


class Observer:
    """Subscribes to topics of both buses and to presence; a context manager.

    Messages queue in its inbox. One that `yields` loses messages that it is too slow for; for
    others the routers wait, see `protocol.bus`.
    """

    def __init__(
        self,
        v2x: Endpoint,
        world: Endpoint,
        topics: Iterable[str] = ALL_TOPICS,
        *,
        inbox: Inbox | None = None,
        timeout_ms: int = CONNECT_TIMEOUT_MS,
        yields: bool = False,
    ) -> None:
        """Connects.

        Args:
            v2x: where that bus is.
            world: where the world bus is.
            topics: names in the topic table.
            inbox: one with limits of its own, for observers that cannot take all messages.
            timeout_ms: how long the buses may take to answer.
            yields: the routers drop messages that this process is too slow for, however long it is
                stopped; else they wait for it, and delay all others, until they disconnect it.

        Raises:
            BusError: a bus is not there.
        """
        self.inbox = Inbox() if inbox is None else inbox
        self._buses: dict[BusName, ZenohBus] = {}
        try:
            for name, endpoint in ((BusName.V2X, v2x), (BusName.WORLD, world)):
                place = replace(endpoint, yields=yields)
                self._open(name, place, timeout_ms)
        except BaseException:  # an interruption as well
            self._close()
            raise
        self._world = world
        self.subscribe(topics)
        for bus in self._buses.values():
            bus.watch()

    def __enter__(self) -> Observer:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def subscribe(self, topics: Iterable[str]) -> None:
        """Subscribes to these topics as well."""
        for topic in sorted(topics):
            self._buses[TOPICS[topic].bus].subscribe(topic)

    def setup(self, patience_s: float = 10.0) -> Setup:
        """Returns the run's setup, from the world bus's host.

        Raises:
            BusError: the world bus's host did not answer in time.
            ProtocolError: its answer is not a setup.
        """
        until_ns = time.monotonic_ns() + round(patience_s * 1e9)
        while time.monotonic_ns() < until_ns:
            if found := _in_thread(lambda: self._buses[BusName.WORLD].ask("setup", Setup, _ASK_S)):
                return found
        raise BusError(f"{self._world.locator} is up, but nobody there tells the setup of a run")

    def next(self, timeout_s: float = _POLL_S) -> Envelope | Presence | None:
        """Returns the next item, None after the timeout."""
        return self.inbox.get(timeout_s)

    def listen(self, seconds: float) -> Iterator[Envelope | Presence]:
        """Yields received items for a duration."""
        end_ns = time.monotonic_ns() + round(seconds * 1e9)
        while (left_ns := end_ns - time.monotonic_ns()) > 0:
            if (item := self.next(min(_POLL_S, left_ns / 1e9))) is not None:
                yield item

    def _open(self, name: BusName, place: Endpoint, timeout_ms: int) -> None:
        self._buses[name] = _in_thread(lambda: open_bus(name, place, self.inbox, timeout_ms))

    def _close(self) -> None:
        """Closes both buses; a router may be gone already, and nobody is to wait for it."""
        closing = [threading.Thread(target=bus.close, daemon=True) for bus in self._buses.values()]
        for thread in closing:
            thread.start()
        for thread in closing:
            thread.join(_CLOSE_S)


def _in_thread(work: Callable[[], T]) -> T:
    """Calls Zenoh in another thread: the main thread handles no signal within such a call.

    Short attempts would allow that too, but a handshake over a slow link may take longer than one.
    """
    done: list[T] = []
    failed: list[Exception] = []

    def run() -> None:
        try:
            done.append(work())
        except Exception as error:  # noqa: BLE001 - is raised again below
            failed.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(_POLL_S)
    if failed:
        raise failed[0]
    return done[0]


MAX_OPEN_FRAMES = 8
MAX_FRAME_BYTES = 64 << 20
MAX_FRAME_MESSAGES = 1000


@dataclass(slots=True, eq=False)
class BufferedFrame:
    """The messages received of a frame so far."""

    number: int
    received: list[Envelope] = field(default_factory=list)
    size_bytes: int = 0

    def add(self, item: Envelope, *, always: bool) -> None:
        """Adds a message, always or if there is room for it."""
        size_bytes = self.size_bytes + len(item.data)
        is_room = size_bytes <= MAX_FRAME_BYTES and len(self.received) < MAX_FRAME_MESSAGES
        if always or is_room:
            self.size_bytes = size_bytes
            self.received.append(item)

    def messages(self) -> Iterator[Message]:
        """Decodes the messages of the frame, as `keyed_messages` without the keys."""
        return (message for message, _ in self.keyed_messages())

    def keyed_messages(self) -> Iterator[tuple[Message, Mapping[str, str]]]:
        """Decodes the messages of the frame, in their order, each with the parts of its key.

        Those that cannot be decoded are left out.
        """
        for item in self.received:
            if (message := _message_of(self.number, item)) is not None:
                yield message, item.parts


class FrameBuffer:
    """Collects messages by frame and hands out complete frames.

    A frame is complete once the next one has ended: by then slower messages have arrived, too. Only
    the newest complete one is kept, so that a slow observer skips whole frames and never falls
    behind. Frame numbers are not trusted: the order of arrival counts.
    """

    def __init__(self, ending: str) -> None:
        """Makes an empty buffer; each frame ends with its one message of the topic `ending`."""
        self._ending = ending
        self._open: dict[int, BufferedFrame] = {}
        self._ended: int | None = None
        self._whole: BufferedFrame | None = None
        self.left_out = 0

    def take(self, item: Envelope, number: int) -> None:
        """Adds a message to its frame."""
        ends = item.topic == self._ending
        if ends and _message_of(number, item) is None:
            return
        is_new_end = ends and number != self._ended
        self._frame(number).add(item, always=is_new_end)
        if is_new_end:
            self.finish()
            self._ended = number

    def finish(self) -> None:
        """Declares the frame that ended last complete."""
        ended, self._ended = self._ended, None
        if ended is None:
            return
        frame = self._open.pop(ended, None)
        if frame is None or self._whole is not None:
            self.left_out += 1
        self._whole = frame or self._whole

    @property
    def is_due(self) -> bool:
        """Whether a complete frame is ready."""
        return self._whole is not None

    def next(self) -> BufferedFrame | None:
        """Returns the complete frame that is ready, once."""
        frame, self._whole = self._whole, None
        return frame

    def _frame(self, number: int) -> BufferedFrame:
        if number not in self._open:
            while len(self._open) >= MAX_OPEN_FRAMES:
                del self._open[next(iter(self._open))]  # the first that came: numbers may be false
            self._open[number] = BufferedFrame(number)
        return self._open[number]


def _message_of(number: int, item: Envelope) -> Message | None:
    """Decodes a message of a frame; None if it cannot be decoded or is of another frame."""
    try:
        message = item.message
    except ProtocolError:
        return None
    return message if getattr(message, "frame", None) == number else None
