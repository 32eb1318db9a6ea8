"""What each agent's uplink carries, from what the edge sees arrive.

An uplink is busy with a chunk from when the chunk was sent, or from when the one before it had
arrived if that is later, until it has arrived. The rate is the sum of bytes over the sum of busy
time, both aged, so that one late wake-up of either side does not count more than it took. The least
time that a small message ever took is no time of transmission and is taken off.

Both stamps of a chunk must be of one clock: the same machine's, or brought together by whoever
calls. Where they plainly are not, chunks that come one after the other still tell the rate.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

MAX_AGENTS = 512
HALF_LIFE_FRAMES = 3
FORGET_FRAMES = 100
LEAST_MBPS, MOST_MBPS = 0.1, 1000.0
SMALL_BYTES = 1500  # a packet: its way tells the delay, larger ones the rate
SMALL_KEPT = 50
_LONGEST_NS = 10_000_000_000  # between sending and arrival; more, or less than 0: other clocks


@dataclass(slots=True)
class _History:
    """One agent's aged sums and the delays of its last small messages."""

    frame: int
    size_bytes: float = 0.0
    busy_ns: float = 0.0
    arrived_ns: int = 0
    arrived_frame: int = -1
    delays_ns: deque[int] = field(default_factory=lambda: deque(maxlen=SMALL_KEPT))


class Bandwidth:
    """Estimates by agent. Each has a history of its own; those long unheard are forgotten."""

    def __init__(self) -> None:
        self._histories: dict[str, _History] = {}

    def heard(
        self, agent: str, frame: int, size_bytes: int, *, sent_ns: int, received_ns: int
    ) -> None:
        """Takes note of a chunk, be it late or not; too many agents are not remembered."""
        history = self._histories.get(agent)
        if history is None:
            if len(self._histories) >= MAX_AGENTS:
                return
            history = self._histories[agent] = _History(frame)
        self._age(history, frame)
        busy_ns = _busy_ns(history, frame, size_bytes, sent_ns, received_ns)
        history.arrived_ns = max(history.arrived_ns, received_ns)
        history.arrived_frame = frame
        if busy_ns is not None:
            history.size_bytes += size_bytes
            history.busy_ns += busy_ns

    def mbps(self, agent: str) -> float | None:
        """Returns the estimate, from 0.1 to 1000 Mbit/s; None while nothing tells it."""
        history = self._histories.get(agent)
        if history is None or history.size_bytes == 0:
            return None
        rate = history.size_bytes * 8e3 / max(history.busy_ns, 1.0)
        return min(max(rate, LEAST_MBPS), MOST_MBPS)

    def forget(self, frame: int) -> None:
        """Drops the agents that were not heard of for long before this frame."""
        for agent in [a for a, h in self._histories.items() if h.frame < frame - FORGET_FRAMES]:
            del self._histories[agent]

    @staticmethod
    def _age(history: _History, frame: int) -> None:
        passed = max(frame - history.frame, 0)
        fading = 0.5 ** (passed / HALF_LIFE_FRAMES)
        history.size_bytes *= fading
        history.busy_ns *= fading
        history.frame = max(frame, history.frame)


def _busy_ns(
    history: _History, frame: int, size_bytes: int, sent_ns: int, received_ns: int
) -> int | None:
    """Returns how long the uplink was busy with a chunk; None if that cannot be told."""
    if not 0 <= received_ns - sent_ns <= _LONGEST_NS:
        follows = history.arrived_frame == frame and history.arrived_ns > 0
        return max(received_ns - history.arrived_ns, 0) if follows else None
    is_small = size_bytes <= SMALL_BYTES
    if is_small:
        history.delays_ns.append(received_ns - sent_ns)
    begin_ns = sent_ns + min(history.delays_ns, default=0)
    queued = history.arrived_ns > begin_ns
    if is_small and not queued:
        return None
    return max(received_ns - max(begin_ns, history.arrived_ns), 0)
