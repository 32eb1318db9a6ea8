"""The inbox: a bounded queue of messages received from all buses, with a quota for each sender.

A sender is the process in a message's key. Each process that is present has a quota of its own; all
others share one, so that inventing senders gains nothing; messages without a process in their key
share one for each topic. A quota is half of what is free (dynamic thresholds: Choudhury and Hahne
1998), so that a sender alone may take a third of the whole, and where `n` flood at once, one more
still has two thirds of the equal share, 1 / (n + 2).
"""

from __future__ import annotations

import queue
import threading
from collections import Counter, deque
from dataclasses import dataclass, replace

from protocol.errors import MessageError, ProtocolError
from protocol.limits import (
    BURST_S,
    EXTRA_QUOTAS,
    MAX_DEBT_S,
    MAX_INBOX_BYTES,
    MAX_INBOX_ITEMS,
    MAX_KEY_CHARS,
    MAX_MESSAGES_PER_S,
    MAX_SENDERS,
    MIN_QUOTA_PER_S,
    QUOTA_OF_FREE,
)
from protocol.logs import RateLimitedLog
from protocol.messages import Message
from protocol.topics import TOPICS, BusName, Topic
from protocol.wire import decode

STRANGERS = ""
UNSIGNED = "/"  # before a topic's name; no process has such an id


@dataclass(slots=True)
class _Sender:
    messages: int = 0
    size_bytes: int = 0
    tokens: float | None = None  # of messages; None for one that has not sent any
    filled_ns: int = 0


class SenderQuotas:
    """Counts queued messages by sender, and limits message rates (token bucket).

    With `is_paced`, in realtime, each sender's rate; else only that of unknown senders.
    """

    def __init__(self, capacity: int, max_bytes: int, *, is_paced: bool) -> None:
        self._capacity = capacity
        self._max_bytes = max_bytes
        self._is_paced = is_paced
        self._known: set[str] = set()
        self._senders: dict[str, _Sender] = {STRANGERS: _Sender()}
        self._all = _Sender()
        self._per_s = self._rate_per_s()

    def show(self, process: str, *, alive: bool) -> None:
        """Registers that a process appeared or left."""
        if not alive:
            self._known.discard(process)
            self._forget(process)
        elif len(self._known) < MAX_SENDERS:
            self._known.add(process)
        self._per_s = self._rate_per_s()

    def sender_of(self, topic: Topic, key: str) -> str:
        """Returns whose quota a message takes."""
        process = topic.process(key)
        if process is None:
            return UNSIGNED + topic.name
        return process if process in self._known else STRANGERS

    def keeps_pace(self, sender: str, now_ns: int) -> bool:
        """Whether a sender's rate limit admits one more message; each attempt uses up rate."""
        if sender.startswith(UNSIGNED) or not (self._is_paced or sender == STRANGERS):
            return True
        return self._take_token(self._senders.setdefault(sender, _Sender()), now_ns)

    def has_room(self, sender: str, growth: tuple[int, int]) -> bool:
        """Whether so many more messages and bytes of a sender may be queued."""
        known = self._senders.setdefault(sender, _Sender())
        places = self._capacity - self._all.messages
        free_bytes = self._max_bytes - self._all.size_bytes
        has_place = growth[0] <= 0 or known.messages + growth[0] <= QUOTA_OF_FREE * places
        fits = growth[1] <= 0 or known.size_bytes + growth[1] <= QUOTA_OF_FREE * free_bytes
        return has_place and fits

    def add(self, sender: str, growth: tuple[int, int]) -> None:
        """Adds messages and bytes to a sender's count, or subtracts them."""
        for one in (self._senders[sender], self._all):
            one.messages += growth[0]
            one.size_bytes += growth[1]
        self._forget(sender)

    def _forget(self, sender: str) -> None:
        """Forgets a sender that has left and of which nothing is queued."""
        if sender in self._known or sender == STRANGERS:
            return
        if sender in self._senders and not self._senders[sender].messages:
            del self._senders[sender]

    def flooding(self, now_ns: int) -> set[str]:
        """Returns the senders that are over their rate limit."""
        return {name for name, known in self._senders.items() if self._tokens(known, now_ns) < 1}

    def _rate_per_s(self) -> float:
        """Returns the messages a second that each sender may send."""
        return max(MAX_MESSAGES_PER_S / (len(self._known) + EXTRA_QUOTAS), MIN_QUOTA_PER_S)

    def _tokens(self, known: _Sender, now_ns: int) -> float:
        most = BURST_S * self._per_s
        if known.tokens is None:
            return most
        passed_s = max(now_ns - known.filled_ns, 0) / 1e9
        return min(known.tokens + passed_s * self._per_s, most)

    def _take_token(self, known: _Sender, now_ns: int) -> bool:
        tokens = self._tokens(known, now_ns)
        known.tokens = max(tokens - 1.0, -MAX_DEBT_S * self._per_s)
        known.filled_ns = max(now_ns, known.filled_ns)
        return tokens >= 1.0


class Envelope:
    """A received message with its topic's name, the parts of its key, arrival time and bytes."""

    __slots__ = ("_message", "data", "parts", "received_ns", "topic")

    def __init__(
        self,
        topic: str,
        parts: dict[str, str],
        message: Message | None,
        received_ns: int,
        data: bytes,
    ) -> None:
        """Stores the fields; a message that is None has not been decoded yet."""
        self.topic = topic
        self.parts = parts
        self.received_ns = received_ns
        self.data = data
        self._message = message

    @property
    def message(self) -> Message:
        """The decoded message; decoded at first use, unless the inbox did so.

        Raises:
            ProtocolError: it cannot be read.
        """
        if self._message is None:
            self._message = decode(self.data, TOPICS[self.topic].message)
        return self._message


@dataclass(frozen=True, slots=True)
class Presence:
    """A process appeared on a bus or left it, by its liveliness token."""

    role: str
    id: str
    alive: bool
    bus: BusName = BusName.V2X


@dataclass(frozen=True, slots=True, eq=False)
class RawMessage:
    """Bytes as they arrived, not yet decoded; `sender` is whose quota of an inbox they take."""

    topic: Topic
    key: str
    data: bytes
    received_ns: int
    sender: str = ""


class Inbox:
    """A queue, bounded in items and in bytes.

    A bad message is dropped, counted in `drops`, and logged once a topic and kind of error.
    """

    def __init__(self, capacity: int = MAX_INBOX_ITEMS, max_bytes: int = MAX_INBOX_BYTES) -> None:
        self._queue: queue.Queue[_Entry] = queue.Queue(capacity)
        self._capacity = capacity
        self._max_bytes = max_bytes
        self._quotas: SenderQuotas | None = None
        self._bytes = 0
        self._limits: dict[str, int] = {}
        self._waiting: dict[_Place, deque[RawMessage]] = {}
        self._lock = threading.Lock()
        self._woken = False
        self._reads = True
        self._complaints = RateLimitedLog()
        self.drops: Counter[str] = Counter()

    def limit(self, topic_name: str, waiting: int) -> None:
        """Limits how many messages of each key of a topic queue; a newer one replaces the oldest.

        So a sender that floods a key displaces only its own messages.
        """
        self._limits[topic_name] = waiting

    def keep_encoded(self) -> None:
        """Delivers messages undecoded, for a role that stores most of them as they arrived."""
        self._reads = False

    def set_quotas(self, *, is_paced: bool) -> None:
        """Gives each sender a quota of its own, and a rate limit as `SenderQuotas` describes.

        Call it before anything is received. Messages beyond the rate are counted as `rate_limited`.
        """
        self._quotas = SenderQuotas(self._capacity, self._max_bytes, is_paced=is_paced)

    def flooding(self, now_ns: int) -> set[str]:
        """Returns the processes that exceed their rate limit."""
        with self._lock:
            return self._quotas.flooding(now_ns) if self._quotas else set()

    def put(self, item: RawMessage | Presence) -> None:
        """Takes an item from a transport's thread; a full inbox counts and drops it."""
        if isinstance(item, RawMessage) and len(item.key) > MAX_KEY_CHARS:
            error = MessageError(f"its key has {len(item.key)} characters")
            self.refuse(item.topic.name, error, item.key)
            return
        with self._lock:
            signed = self._signed(item)
            if signed is None:  # first of all, since a flood must cost little
                self.drops["rate_limited"] += 1
                return
            item = signed
            oldest = self._oldest_beside(item)
            growth = _size_bytes(item) - _size_bytes(oldest)
            if not self._has_room(item, (int(oldest is None), growth)):
                self.drops["rate_limited"] += 1
                return
            no_place = oldest is None and self._queue.full()
            if no_place or self._bytes + growth > self._max_bytes:
                self.drops["inbox_full"] += 1
                return
            self._bytes += growth
            self._use_quota(item, 1)
            if oldest is not None:  # the newer one is read in the place of the oldest
                self._waiting[_place(oldest)].popleft()
                self._use_quota(oldest, -1)
                self.drops["overtaken"] += 1
            entry = self._wait(item)
            if oldest is None:
                self._queue.put_nowait(entry)

    @property
    def is_empty(self) -> bool:
        """Whether the queue is empty."""
        return self._queue.empty()

    def wake(self) -> None:
        """Ends the current wait for an item, or else the next one; from any thread."""
        with self._lock:
            if not self._woken and not self._queue.full():  # a full inbox lets nobody wait
                self._woken = True
                self._queue.put_nowait(None)

    def get(self, timeout_s: float = 0.0) -> Envelope | Presence | None:
        """Returns the next item, or None after the timeout or if the next one cannot be decoded.

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
            if isinstance(item, tuple):
                item = self._pop_waiting(item)
            self._bytes -= _size_bytes(item)
            self._use_quota(item, -1)
        return item if isinstance(item, Presence) else self._open(item)

    def refuse(self, topic: str, error: ProtocolError, key: str = "") -> None:
        """Counts a message that this or a later stage found invalid; `key` is its key."""
        self.drops[type(error).__name__] += 1
        self._complaints.refused(topic, key or topic, error)

    def fail(self, topic: str, error: Exception) -> None:
        """Counts a message that its role failed to handle, by a fault of the role."""
        self.drops["role_error"] += 1
        self._complaints.failed(topic, error)

    def _signed(self, item: RawMessage | Presence) -> RawMessage | Presence | None:
        """Returns an item with the sender whose quota it takes; None if it is over its rate.

        Keeps track of presence.
        """
        if self._quotas is None:
            return item
        if isinstance(item, RawMessage):
            sender = self._quotas.sender_of(item.topic, item.key)
            keeps_pace = self._quotas.keeps_pace(sender, item.received_ns)
            return replace(item, sender=sender) if keeps_pace else None
        self._quotas.show(item.id, alive=item.alive)
        return item

    def _has_room(self, item: RawMessage | Presence, growth: tuple[int, int]) -> bool:
        if self._quotas is None or isinstance(item, Presence):
            return True
        return self._quotas.has_room(item.sender, growth)

    def _use_quota(self, item: RawMessage | Presence, times: int) -> None:
        """Counts an item as queued, or with -1 as no longer queued."""
        if self._quotas is not None and isinstance(item, RawMessage):
            self._quotas.add(item.sender, (times, times * len(item.data)))

    def _oldest_beside(self, item: RawMessage | Presence) -> RawMessage | None:
        """Returns the item that a new one replaces: the oldest of its key, at its limit."""
        if not isinstance(item, RawMessage):
            return None
        waiting = self._waiting.get(_place(item), deque())
        return waiting[0] if len(waiting) >= self._limits.get(item.topic.name, 1) else None

    def _wait(self, item: RawMessage | Presence) -> _Place | RawMessage | Presence:
        """Returns an item's queue entry: only its place if newer items may replace it."""
        if not isinstance(item, RawMessage) or item.topic.name not in self._limits:
            return item
        place = _place(item)
        self._waiting.setdefault(place, deque()).append(item)
        return place

    def _pop_waiting(self, place: _Place) -> RawMessage:
        waiting = self._waiting[place]
        item = waiting.popleft()
        if not waiting:
            del self._waiting[place]
        return item

    def _open(self, sealed: RawMessage) -> Envelope | None:
        try:
            message = decode(sealed.data, sealed.topic.message) if self._reads else None
            parts = sealed.topic.parts(sealed.key)
        except ProtocolError as error:
            self.refuse(sealed.topic.name, error, sealed.key)
            return None
        return Envelope(sealed.topic.name, parts, message, sealed.received_ns, sealed.data)


_Place = tuple[str, str]
_Entry = _Place | RawMessage | Presence | None


def _place(item: RawMessage) -> _Place:
    """Returns topic and key: what is published at `cpnet/**` comes on many topics by one key."""
    return item.topic.name, item.key


def _size_bytes(item: RawMessage | Presence | None) -> int:
    return len(item.data) if isinstance(item, RawMessage) else 0
