"""Clock offsets between machines, estimated from round trips on the bus.

A query goes to the process that hosts the bus's router; half the round trip, less the time that the
answer took there, is the most by which the estimate can be wrong. The round trip with the smallest
such error counts (minimum-delay filter); its error grows as it ages, because clocks drift.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from protocol.errors import ProtocolError
from protocol.limits import MAX_OFFSET_NS
from protocol.messages import ClockReading, Message, TimeReply

DRIFT = 100e-6  # 50 ppm a quartz, two of them
KEPT = 32
BURST = 8
BURST_PERIOD_S = 0.02
PERIOD_S = 2.0
REPLY_TIMEOUT_S = 0.5
_log = logging.getLogger(__name__)
M = TypeVar("M", bound=Message)


class ClockBus(Protocol):
    """The methods of a bus that the clock needs."""

    def publish(self, topic_name: str, message: Message, **parts: str) -> int:
        """See `protocol.bus.Bus`."""

    def ask(self, topic_name: str, message: type[M], timeout_s: float) -> M | None:
        """Returns the answer of the router's host, None if none came."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """One query and its reply: sent and answered by this clock, received and replied by that."""

    asked_ns: int
    received_ns: int
    replied_ns: int
    answered_ns: int

    @property
    def offset_ns(self) -> int:
        """Offset from this clock to the other one, if both directions took equally long."""
        return (self.received_ns - self.asked_ns + self.replied_ns - self.answered_ns) // 2

    @property
    def error_ns(self) -> int:
        """The most by which the offset can be wrong, however unequal the two delays were."""
        return (self.answered_ns - self.asked_ns - (self.replied_ns - self.received_ns) + 1) // 2

    def error_at_ns(self, now_ns: int) -> int:
        """The largest error of the offset at a later time, with the clocks' drift."""
        return self.error_ns + round(DRIFT * max(0, now_ns - self.answered_ns))


class OffsetFilter:
    """Minimum-delay filter: keeps the last exchanges and returns the one with the least error."""

    def __init__(self) -> None:
        self._kept: deque[Exchange] = deque(maxlen=KEPT)

    def add(self, exchange: Exchange) -> None:
        """Adds an exchange; one that contradicts itself, or cannot be a clock's, is ignored."""
        in_order = exchange.error_ns >= 0 and exchange.replied_ns >= exchange.received_ns
        if in_order and abs(exchange.offset_ns) <= MAX_OFFSET_NS:
            self._kept.append(exchange)

    def best(self, now_ns: int) -> tuple[int, int] | None:
        """Returns offset and error in ns, None before the first exchange."""
        if not self._kept:
            return None
        best = min(self._kept, key=lambda exchange: exchange.error_at_ns(now_ns))
        return best.offset_ns, best.error_at_ns(now_ns)


class ClockWatch:
    """Measures the clock offset from time to time, in a thread of its own, and publishes it."""

    def __init__(self, process: str, bus: ClockBus, machine: str | None = None) -> None:
        self._process = process
        self._bus = bus
        self._machine = machine or this_machine()
        self._filter = OffsetFilter()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clock", daemon=True)

    def start(self) -> None:
        """Starts the thread that measures the offset."""
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread."""
        self._stop.set()
        self._thread.join(2 * REPLY_TIMEOUT_S)

    def _run(self) -> None:
        """Publishes repeatedly: a recorder may start later, or restart."""
        is_same = False
        while not self._stop.is_set():
            if is_same:
                self._tell(0, 0)
            else:
                is_same = self.ask_once()
            self._stop.wait(PERIOD_S)

    def ask_once(self) -> bool:
        """Measures and publishes the offset; returns whether both processes read the same clock."""
        for _ in range(BURST):
            asked_ns = time.monotonic_ns()
            reply = self._ask()
            answered_ns = time.monotonic_ns()
            if reply is not None and reply.machine == self._machine:
                self._tell(0, 0)  # the same clock
                return True
            if reply is not None:
                exchange = Exchange(asked_ns, reply.received_ns, reply.replied_ns, answered_ns)
                self._filter.add(exchange)
            if self._stop.wait(BURST_PERIOD_S):
                break
        if found := self._filter.best(time.monotonic_ns()):
            self._tell(*found)
        return False

    def _ask(self) -> TimeReply | None:
        try:
            return self._bus.ask("time", TimeReply, REPLY_TIMEOUT_S)
        except ProtocolError as error:
            _log.warning("the clock's answer cannot be read: %s", error)
            return None

    def _tell(self, offset_ns: int, error_ns: int) -> None:
        reading = ClockReading(process=self._process, offset_ns=offset_ns, error_ns=error_ns)
        self._bus.publish("clock", reading, process=self._process)


def time_reply(machine: str | None = None) -> Callable[[], TimeReply]:
    """Returns the reply of the router's host to a query for its clock."""
    name = machine or this_machine()

    def reply() -> TimeReply:
        received_ns = time.monotonic_ns()
        return TimeReply(machine=name, received_ns=received_ns, replied_ns=time.monotonic_ns())

    return reply


def this_machine() -> str:
    """Returns a name that two processes share only if they read the same monotonic clock."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    namespace = Path("/proc/self/ns/time")
    try:
        return f"{boot.read_text().strip()} {namespace.readlink()}"
    except OSError:  # not Linux, or older than 5.6: the offset is measured, which is right as well
        return f"process {time.monotonic_ns()}"
