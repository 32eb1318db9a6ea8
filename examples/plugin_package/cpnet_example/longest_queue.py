"""A signal policy: green to whom most vehicles stand still before, whatever lies behind."""

from __future__ import annotations

from protocol.messages import LaneCounts
from signal_controller.config import SignalConfig
from signal_controller.observation import Observation, SignalSite
from signal_controller.policies import Decision


class LongestQueue:
    """Made once, for a signal; called for every frame."""

    def __init__(self, config: SignalConfig, site: SignalSite) -> None:
        self._signal = site.signal

    def decide(self, observation: Observation) -> Decision:
        """Returns the green with the longest queue; the present one, if it is among them."""
        greens, shown = self._signal.greens, observation.shown
        queues = [self._queued(green, observation.counts) for green in greens]
        present = shown.green if shown is not None else None
        state = max(greens, key=lambda g: (queues[greens.index(g)], g == present))
        return Decision(state, queues, "longest-queue")

    def _queued(self, green: str, counts: LaneCounts) -> float:
        lanes = {link.from_lane for link in self._signal.links if green[link.index] in "Gg"}
        return float(sum(counts.stationary_upstream.get(lane, 0) for lane in lanes))
