"""Where a process finds all that came in, from every bus, in order of arrival."""

from __future__ import annotations

import logging
import queue
import threading
from collections import Counter, deque
from dataclasses import dataclass

from protocol.errors import ProtocolError
from protocol.messages import Message
from protocol.topics import BusName, Topic
from protocol.wire import decode

CAPACITY = 4096
CAPACITY_BYTES = 256 << 20  # sixteen of the largest messages, or 8000 scans
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Envelope:
    """A message with its topic's name, the parts of its key and when its bytes arrived."""

    topic: str
    parts: dict[str, str]
    message: Message
    received_ns: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Presence:
    """A process appeared on a bus or left it, by its liveliness token."""

    role: str
    id: str
    alive: bool
    bus: BusName = BusName.V2X


@dataclass(frozen=True, slots=True, eq=False)
class Sealed:
    """Bytes as they came, not yet read."""

    topic: Topic
    key: str
    data: bytes
    received_ns: int


class Inbox:
    """A queue, bounded in items and in bytes.

    A bad message is dropped, counted in `drops`, and logged once a key.
    """

    def __init__(self, capacity: int = CAPACITY, max_bytes: int = CAPACITY_BYTES) -> None:
        self._queue: queue.Queue[str | Sealed | Presence | None] = queue.Queue(capacity)
        self._max_bytes = max_bytes
        self._bytes = 0
        self._limits: dict[str, int] = {}
        self._waiting: dict[str, deque[Sealed]] = {}
        self._lock = threading.Lock()
        self._woken = False
        self._told: set[tuple[str, str]] = set()
        self.drops: Counter[str] = Counter()

    def limit(self, topic_name: str, waiting: int) -> None:
        """Lets so many messages of each key of a topic wait; a newer one drives out the oldest.

        So whoever floods a key is in nobody's way but its own.
        """
        self._limits[topic_name] = waiting

    def put(self, item: Sealed | Presence) -> None:
        """Takes an item from a transport's thread; a full inbox counts and drops it."""
        with self._lock:
            oldest = self._oldest_beside(item)
            growth = _size_bytes(item) - _size_bytes(oldest)
            no_place = oldest is None and self._queue.full()
            if no_place or self._bytes + growth > self._max_bytes:
                self.drops["inbox_full"] += 1
                return
            self._bytes += growth
            if oldest is not None:  # the newer one is read in the place of the oldest
                self._waiting[oldest.key].popleft()
                self.drops["overtaken"] += 1
            entry = self._wait(item)
            if oldest is None:
                self._queue.put_nowait(entry)

    def wake(self) -> None:
        """Ends the wait of whoever waits for an item, or else the next one; from any thread."""
        with self._lock:
            if not self._woken and not self._queue.full():  # a full inbox lets nobody wait
                self._woken = True
                self._queue.put_nowait(None)

    def get(self, timeout_s: float = 0.0) -> Envelope | Presence | None:
        """Returns the next item that can be read, or None when the time is over.

        None comes at once if there is no item and `wake` was called since the last wait.
        """
        try:
            item = self._queue.get(timeout_s > 0, timeout_s or None)
            while item is None:
                self._woken = False
                item = self._queue.get_nowait()
        except queue.Empty:
            return None
        with self._lock:
            if isinstance(item, str):
                item = self._pop_waiting(item)
            self._bytes -= _size_bytes(item)
        return item if isinstance(item, Presence) else self._open(item)

    def refuse(self, key: str, error: ProtocolError) -> None:
        """Counts a message that a later stage found to be bad."""
        reason = type(error).__name__
        self.drops[reason] += 1
        if self._is_news(key, reason):
            _log.warning("dropped a message on %s: %s (later ones are only counted)", key, error)

    def fail(self, key: str, error: Exception) -> None:
        """Counts a message that its role could not take, by a fault of the role."""
        self.drops["role_error"] += 1
        if self._is_news(key, "role_error"):
            _log.error(
                "a message on %s went wrong (later ones are only counted)", key, exc_info=error
            )

    def _is_news(self, key: str, reason: str) -> bool:
        if (key, reason) in self._told or len(self._told) >= CAPACITY:
            return False
        self._told.add((key, reason))
        return True

    def _oldest_beside(self, item: Sealed | Presence) -> Sealed | None:
        """Returns what an item drives out: the oldest of its key, if no more may wait."""
        if not isinstance(item, Sealed):
            return None
        waiting = self._waiting.get(item.key, deque())
        return waiting[0] if len(waiting) >= self._limits.get(item.topic.name, 1) else None

    def _wait(self, item: Sealed | Presence) -> str | Sealed | Presence:
        """Returns what stands in the queue for an item: the key alone where others may come."""
        if not isinstance(item, Sealed) or item.topic.name not in self._limits:
            return item
        self._waiting.setdefault(item.key, deque()).append(item)
        return item.key

    def _pop_waiting(self, key: str) -> Sealed:
        waiting = self._waiting[key]
        item = waiting.popleft()
        if not waiting:
            del self._waiting[key]
        return item

    def _open(self, sealed: Sealed) -> Envelope | None:
        try:
            message = decode(sealed.data, sealed.topic.message)
            parts = sealed.topic.parts(sealed.key)
        except ProtocolError as error:
            self.refuse(sealed.key, error)
            return None
        size = len(sealed.data)
        return Envelope(sealed.topic.name, parts, message, sealed.received_ns, size)


def _size_bytes(item: Sealed | Presence | None) -> int:
    return len(item.data) if isinstance(item, Sealed) else 0
