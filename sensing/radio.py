"""One agent's radio: whether its link takes more, and when what it sends arrives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

from protocol.bus import Bus
from sensing.link.config import LinkConfig
from sensing.link.path import Path
from sensing.link.virtual import VirtualLink

ENVELOPE_BYTES = 320  # a scan without its payload, or a pose, with Zenoh's key and framing

AgentKind = Literal["vehicle", "roadside"]


@dataclass(frozen=True, slots=True)
class Passage:
    """A message's way over a virtual link, in simulated time."""

    sent_ns: int
    arrival_ns: int

    @property
    def took_ns(self) -> int:
        """Time in the queue and on the link."""
        return self.arrival_ns - self.sent_ns


class Radio(Protocol):
    """What an agent asks before it senses, and tells when it sends."""

    def is_clogged(self, sim_time_ns: int) -> bool:
        """Whether what is queued takes longer to leave than a frame lasts: skip a scan."""

    def carry(self, sim_time_ns: int, size_bytes: int) -> Passage | None:
        """Takes note of a message of a frame; None where the link is real."""


class RealRadio:
    """The transport itself is the link. TCP tells what it could not send yet."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._sent_bytes = bus.wire_bytes()

    def is_clogged(self, sim_time_ns: int) -> bool:  # noqa: ARG002 - a real link has its own time
        """Compares what waits with what left since the last frame."""
        before, self._sent_bytes = self._sent_bytes, self._bus.wire_bytes()
        return self._bus.unsent_bytes() > max(0, self._sent_bytes - before)

    def carry(self, sim_time_ns: int, size_bytes: int) -> None:
        """See `Radio.carry`."""


class IdealRadio:
    """Takes everything; used in lockstep where no link is modelled."""

    def is_clogged(self, sim_time_ns: int) -> bool:  # noqa: ARG002 - never
        """See `Radio.is_clogged`."""
        return False

    def carry(self, sim_time_ns: int, size_bytes: int) -> None:
        """See `Radio.carry`."""


class VirtualRadio:
    """A virtual link, or none for an agent that is wired; sends `lead_ns` after a frame's time."""

    def __init__(self, link: VirtualLink | None, lead_ns: int, period_ns: int) -> None:
        self._link = link
        self._lead_ns = lead_ns
        self._period_ns = period_ns

    def is_clogged(self, sim_time_ns: int) -> bool:
        """See `Radio.is_clogged`."""
        if self._link is None:
            return False
        return self._link.backlog_ns(sim_time_ns + self._lead_ns) > self._period_ns

    def carry(self, sim_time_ns: int, size_bytes: int) -> Passage:
        """See `Radio.carry`."""
        sent_ns = sim_time_ns + self._lead_ns
        arrival_ns = sent_ns if self._link is None else self._link.send(sent_ns, size_bytes)
        return Passage(sent_ns, arrival_ns)


def radio_of(
    scenario: dict[str, Any], config: LinkConfig, kind: AgentKind, agent: str, bus: Bus
) -> Radio:
    """Returns the radio that a scenario gives to an agent with this connection."""
    if scenario["mode"] == "realtime":
        return RealRadio(bus)
    if config.way(scenario["mode"]) == "none":
        return IdealRadio()
    profile = config.profile if kind == "vehicle" else config.roadside_profile
    link = None if profile is None else VirtualLink(Path.draw(profile, scenario["seed"], agent))
    lead_ns = round(config.agent_compute_ms * 1e6)
    return VirtualRadio(link, lead_ns, round(scenario["frame_period_s"] * 1e9))
