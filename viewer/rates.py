"""What each agent uploads, in Mbit/s of the world's time."""

from __future__ import annotations

from collections import deque

from protocol.messages import Metrics

WINDOW_NS = 1_000_000_000
MAX_AGENTS = 1024
_MAX_FRAMES = 256  # of the window


class Rates:
    """Adds up payloads over the last second."""

    def __init__(self, frame_period_ns: int) -> None:
        self._period_ns = frame_period_ns
        self._sent: dict[str, deque[tuple[int, int]]] = {}

    def take(self, metrics: Metrics) -> None:
        """Takes what a process says that its agents sent; of too many agents no more are heard."""
        for upload in metrics.uploads:
            if upload.agent in self._sent or len(self._sent) < MAX_AGENTS:
                sent = self._sent.setdefault(upload.agent, deque(maxlen=_MAX_FRAMES))
                sent.append((metrics.sim_time_ns, upload.payload_bytes))

    def mbps(self, now_ns: int) -> dict[str, float]:
        """Returns each agent's rate in the second before this moment; who sent nothing is left out.

        Who came within the second has the rate since then.
        """
        rates = {}
        for agent, sent in list(self._sent.items()):
            while sent and sent[0][0] <= now_ns - WINDOW_NS:
                sent.popleft()
            if not sent:
                del self._sent[agent]
                continue
            heard_ns = min(WINDOW_NS, max(now_ns - sent[0][0], 0) + self._period_ns)
            rates[agent] = sum(size for at_ns, size in sent if at_ns <= now_ns) * 8e3 / heard_ns
        return rates
