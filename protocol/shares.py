"""What each sender may fill of an inbox, and how fast: whoever floods is in nobody's way.

A sender is the process in a message's key. Each that has shown itself has a share of its own; all
others have one share together, so that inventing senders helps nobody, and so have messages that no
process signs. Shares sum up to the whole: no sender can take another's.
"""

from __future__ import annotations

from dataclasses import dataclass

MOST_SENDERS = 128  # with a share of their own
BESIDES = 2  # shares: of strangers, and of what no process signs
TOTAL_PER_S = 8000.0  # messages of all senders that a role reads without being late
LEAST_PER_S = 1000.0  # of one: what a process with twenty agents may send at 10 Hz
BURST_S = 0.5  # so much of its rate may come at once
GRUDGE_S = 1.0  # so much of its rate, at most, must be made up for
STRANGERS, UNSIGNED = "", "/"  # no process has such an id


@dataclass(slots=True)
class _Sender:
    messages: int = 0
    size_bytes: int = 0
    tokens: float | None = None  # of messages; None for one that has not sent any
    filled_ns: int = 0


class Shares:
    """Counts what waits by sender. `is_paced` is for the wall clock: a rate holds as well."""

    def __init__(self, capacity: int, max_bytes: int, *, is_paced: bool) -> None:
        self._capacity = capacity
        self._max_bytes = max_bytes
        self._is_paced = is_paced
        self._known: set[str] = set()
        self._senders: dict[str, _Sender] = {STRANGERS: _Sender(), UNSIGNED: _Sender()}

    def show(self, process: str, *, alive: bool) -> None:
        """Takes note of a process that appeared or vanished."""
        if not alive:
            self._known.discard(process)
            self._forget(process)
        elif len(self._known) < MOST_SENDERS:
            self._known.add(process)

    def sender_of(self, process: str | None) -> str:
        """Returns whose share a message of a process takes; None for one that none signs."""
        if process is None:
            return UNSIGNED
        return process if process in self._known else STRANGERS

    def admits(self, sender: str, growth: tuple[int, int], now_ns: int) -> bool:
        """Whether a sender may add so many messages and bytes; each attempt counts for its rate."""
        known = self._senders.setdefault(sender, _Sender())
        keeps_pace = not self._is_paced or sender == UNSIGNED or self._take_token(known, now_ns)
        shares = len(self._known) + BESIDES
        has_room = known.messages + growth[0] <= max(self._capacity // shares, 1)
        return keeps_pace and has_room and known.size_bytes + growth[1] <= self._max_bytes // shares

    def add(self, sender: str, growth: tuple[int, int]) -> None:
        """Counts messages and bytes, or takes them away."""
        known = self._senders[sender]
        known.messages += growth[0]
        known.size_bytes += growth[1]
        self._forget(sender)

    def _forget(self, sender: str) -> None:
        """Lets a sender go that has left and of which nothing waits."""
        if sender in self._known or sender in (STRANGERS, UNSIGNED):
            return
        if sender in self._senders and not self._senders[sender].messages:
            del self._senders[sender]

    def flooding(self, now_ns: int) -> set[str]:
        """Returns the senders that have sent more than their rate allows, and not yet made up."""
        return {name for name, known in self._senders.items() if self._tokens(known, now_ns) < 1}

    @property
    def _per_s(self) -> float:
        return max(TOTAL_PER_S / (len(self._known) + BESIDES), LEAST_PER_S)

    def _tokens(self, known: _Sender, now_ns: int) -> float:
        most = BURST_S * self._per_s
        if known.tokens is None:
            return most
        passed_s = max(now_ns - known.filled_ns, 0) / 1e9
        return min(known.tokens + passed_s * self._per_s, most)

    def _take_token(self, known: _Sender, now_ns: int) -> bool:
        tokens = self._tokens(known, now_ns)
        known.tokens = max(tokens - 1.0, -GRUDGE_S * self._per_s)
        known.filled_ns = max(now_ns, known.filled_ns)
        return tokens >= 1.0
