"""Observers of a run: they attach to both buses, publish nothing and hold up nobody.

An observer attaches and leaves at any time; no process waits for it, except for a recording on the
same machine. `FrameBuffer` keeps the messages of the newest frames undecoded.
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
_ASK_S = 2.0
_CLOSE_S = 1.0
_POLL_S = 0.1

T = TypeVar("T")


def lower_priority() -> None:
    """Lets all other processes run first (SCHED_IDLE), whatever priority this one started with.

    A low nice value still keeps a core for milliseconds from a process that wakes up meanwhile,
    which a frame that passes through many processes feels; idle work yields it at once.
    """
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


class Observer:
    """Subscribes to topics of both buses and to presence; a context manager.

    Messages wait in its inbox. One that `yields` loses what it is too slow for; for others the
    routers wait, see `protocol.bus`.
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
            world: the same of the other one.
            topics: names in the topic table.
            inbox: one with limits of its own, for who cannot take all that comes.
            timeout_ms: how long the buses may take to answer.
            yields: what this process is too slow for is dropped before it, however long it stands
                still; else the routers wait for it, and everybody with them, until they give it up.

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
        """Asks for these topics as well."""
        for topic in sorted(topics):
            self._buses[TOPICS[topic].bus].subscribe(topic)

    def setup(self, patience_s: float = 10.0) -> Setup:
        """Returns what every process was given before the first frame.

        Raises:
            BusError: the world's host did not say in time.
            ProtocolError: what it said is no setup.
        """
        until_ns = time.monotonic_ns() + round(patience_s * 1e9)
        while time.monotonic_ns() < until_ns:
            if found := _in_thread(lambda: self._buses[BusName.WORLD].ask("setup", Setup, _ASK_S)):
                return found
        raise BusError(f"{self._world.locator} is up, but nobody there tells the setup of a run")

    def next(self, timeout_s: float = _POLL_S) -> Envelope | Presence | None:
        """Returns what came next, None if nothing did in time."""
        return self.inbox.get(timeout_s)

    def listen(self, seconds: float) -> Iterator[Envelope | Presence]:
        """Yields what comes, for so long."""
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
    """Works in another thread: within a call into Zenoh no signal would be heeded.

    Short tries would heed them too, but a handshake over a slow link may take longer than one.
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
    """What was heard of a frame so far."""

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
        """Reads the messages of the frame, as `keyed_messages` without the keys."""
        return (message for message, _ in self.keyed_messages())

    def keyed_messages(self) -> Iterator[tuple[Message, Mapping[str, str]]]:
        """Reads the messages of the frame, in their order, each with the parts of its key.

        What cannot be read is left out.
        """
        for item in self.received:
            if (message := _message_of(self.number, item)) is not None:
                yield message, item.parts


class FrameBuffer:
    """The frames in the making.

    A frame is whole once the next one was brought to an end: by then all that travels slower has
    come, too. Only the newest whole one waits, so that who is slow leaves frames out, whole ones,
    and never falls behind. No frame's number is trusted: what counts is the order of arrival.
    """

    def __init__(self, ending: str) -> None:
        """Begins; `ending` is a topic of which a message ends each frame, once in each."""
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
        """Calls the frame that ended last whole."""
        ended, self._ended = self._ended, None
        if ended is None:
            return
        frame = self._open.pop(ended, None)
        if frame is None or self._whole is not None:
            self.left_out += 1
        self._whole = frame or self._whole

    @property
    def is_due(self) -> bool:
        """Whether a whole frame waits."""
        return self._whole is not None

    def next(self) -> BufferedFrame | None:
        """Returns the whole frame that waits, once."""
        frame, self._whole = self._whole, None
        return frame

    def _frame(self, number: int) -> BufferedFrame:
        if number not in self._open:
            while len(self._open) >= MAX_OPEN_FRAMES:
                del self._open[next(iter(self._open))]  # the first that came: numbers may lie
            self._open[number] = BufferedFrame(number)
        return self._open[number]


def _message_of(number: int, item: Envelope) -> Message | None:
    """Returns what was said of a frame, None if it cannot be read or is of another frame."""
    try:
        message = item.message
    except ProtocolError:
        return None
    return message if getattr(message, "frame", None) == number else None
