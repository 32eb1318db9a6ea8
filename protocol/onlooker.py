"""Listening to a running system from outside: both buses, nothing said, nobody disturbed."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import TypeVar

from protocol.bus import CONNECT_TIMEOUT_MS, Endpoint, ZenohBus, open_bus
from protocol.errors import BusError
from protocol.inbox import Envelope, Inbox, Presence
from protocol.messages import Setup
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


class RateCap:
    """Lets at most so many works begin in a second."""

    def __init__(self, per_s: float) -> None:
        self._period_ns = round(1e9 / per_s)
        self._due_ns = 0

    def take(self, now_ns: int) -> bool:
        """Whether one may begin now; then the next one must wait."""
        is_due = now_ns >= self._due_ns
        if is_due:
            self._due_ns = now_ns + self._period_ns
        return is_due


class Onlooker:
    """Hears what it asked for, presence included; a context manager.

    It may come and go at any time: no process knows of it. What comes waits until its inbox is
    read. Who `yields` misses what there is no room for; for others the routers wait, see there.
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
            self._hang_up()
            raise
        self._world = world
        self.hear(topics)
        for bus in self._buses.values():
            bus.watch()

    def __enter__(self) -> Onlooker:
        return self

    def __exit__(self, *_: object) -> None:
        self._hang_up()

    def hear(self, topics: Iterable[str]) -> None:
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
            if found := _aside(lambda: self._buses[BusName.WORLD].ask("setup", Setup, _ASK_S)):
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
        self._buses[name] = _aside(lambda: open_bus(name, place, self.inbox, timeout_ms))

    def _hang_up(self) -> None:
        """Closes both buses; a router may be gone already, and nobody is to wait for it."""
        closing = [threading.Thread(target=bus.close, daemon=True) for bus in self._buses.values()]
        for thread in closing:
            thread.start()
        for thread in closing:
            thread.join(_CLOSE_S)


def _aside(work: Callable[[], T]) -> T:
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
