"""An agent's radio: congestion of its link, and arrival times of its messages."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, Protocol

from protocol.bus import Bus
from protocol.messages import NEVER_NS
from protocol.traffic import Traffic, on_air_bytes
from sensing.link_channel import Channel, Transmission, VirtualLink
from sensing.link_config import LinkConfig
from sensing.lossy_link import LossyLink, link_over

ENVELOPE_BYTES = 320  # a scan without its payload, or a pose, with Zenoh's key and framing

AgentKind = Literal["vehicle", "roadside"]


class Radio(Protocol):
    """An agent's side of a link, real or virtual."""

    is_virtual: bool

    def begin(self, sim_time_ns: int, enough_sim_ns: int | None) -> int:
        """Begins a frame; returns how many chunks of the last frame were recalled.

        A chunk that has not begun to leave is recalled when the new frame begins, or when the
        agent receives that the edge completed the frame at `enough_sim_ns`.
        """

    def is_congested(self, sim_time_ns: int) -> bool:
        """Whether the queue takes longer to send than a frame lasts: skip a frame."""

    def reception_ns(self, published_sim_ns: int) -> int:
        """Returns when the agent receives what the edge published at a time, in simulated time."""

    def transmit(self, sim_time_ns: int, size_bytes: int, *, is_chunk: bool) -> Transmission | None:
        """Sends a message over a virtual link; None where the link is real."""

    def traffic(self) -> Traffic:
        """Returns the link's traffic so far, in both directions."""


class RealRadio:
    """A real link: the transport itself; TCP reports what it could not send yet."""

    is_virtual = False

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._sent_bytes = bus.wire_bytes()

    def begin(self, sim_time_ns: int, enough_sim_ns: int | None) -> int:  # noqa: ARG002 - for virtual links
        """Does nothing: in realtime the outbox drops chunks."""
        return 0

    def is_congested(self, sim_time_ns: int) -> bool:  # noqa: ARG002 - a real link has its own time
        """Compares the queued bytes with those sent since the last frame."""
        before, self._sent_bytes = self._sent_bytes, self._bus.wire_bytes()
        return self._bus.unsent_bytes() > max(0, self._sent_bytes - before)

    def reception_ns(self, published_sim_ns: int) -> int:
        """See `Radio.reception_ns`."""
        return published_sim_ns

    def transmit(self, sim_time_ns: int, size_bytes: int, *, is_chunk: bool) -> None:
        """See `Radio.transmit`."""

    def traffic(self) -> Traffic:
        """See `Radio.traffic`; as the transport counts it."""
        return self._bus.traffic()


class IdealRadio(RealRadio):
    """A link without limits; used in lockstep where no link is modelled."""

    def is_congested(self, sim_time_ns: int) -> bool:  # noqa: ARG002 - it takes everything at any time
        """See `Radio.is_congested`."""
        return False


class VirtualRadio:
    """A link in simulated time, none for a wired agent; sends `lead_ns` after a frame's time."""

    is_virtual = True

    def __init__(
        self, bus: Bus, link: VirtualLink | LossyLink | None, lead_ns: int, period_ns: int
    ) -> None:
        self._bus = bus
        self._link = link
        self._lead_ns = lead_ns
        self._period_ns = period_ns
        self._taken_bytes = 0

    def begin(self, sim_time_ns: int, enough_sim_ns: int | None) -> int:
        """See `Radio.begin`."""
        if self._link is None:
            return 0
        until_ns = sim_time_ns + self._lead_ns
        if enough_sim_ns is not None:
            until_ns = min(until_ns, self.reception_ns(enough_sim_ns))
        recalled = self._link.recall(until_ns)
        self._taken_bytes -= sum(transmission.on_air_bytes for transmission in recalled)
        return len(recalled)

    def is_congested(self, sim_time_ns: int) -> bool:
        """See `Radio.is_congested`."""
        if self._link is None:
            return False
        return self._link.backlog_ns(sim_time_ns + self._lead_ns) >= self._period_ns

    def reception_ns(self, published_sim_ns: int) -> int:
        """See `Radio.reception_ns`; the downlink has the same delay and no queue."""
        return published_sim_ns + (
            0 if self._link is None else self._link.delay_ns(published_sim_ns)
        )

    def transmit(self, sim_time_ns: int, size_bytes: int, *, is_chunk: bool) -> Transmission:
        """See `Radio.transmit`; a chunk that will be recalled for the next frame never arrives."""
        sent_ns = sim_time_ns + self._lead_ns
        if self._link is None:
            transmission = Transmission(
                sent_ns, sent_ns, sent_ns, sent_ns, on_air_bytes(size_bytes)
            )
        else:
            transmission = self._link.send(sent_ns, size_bytes, recallable=is_chunk)
        self._taken_bytes += transmission.on_air_bytes
        overtaken = is_chunk and transmission.first_bit_ns >= sent_ns + self._period_ns
        return replace(transmission, arrival_ns=NEVER_NS) if overtaken else transmission

    def traffic(self) -> Traffic:
        """See `Radio.traffic`; recalled messages are not included, retransmissions are."""
        return replace(self._bus.traffic(), data_sent_bytes=self._taken_bytes)


def radio_of(
    scenario: dict[str, Any], config: LinkConfig, kind: AgentKind, agent: str, bus: Bus
) -> Radio:
    """Returns the radio that a scenario gives to an agent with this connection."""
    if scenario["mode"] == "realtime":
        return RealRadio(bus)
    if config.channel(scenario["mode"]) == "none":
        return IdealRadio(bus)
    profile = config.profile if kind == "vehicle" else config.roadside_profile
    link = None if profile is None else link_over(Channel.draw(profile, scenario["seed"], agent))
    lead_ns = round(config.agent_compute_ms * 1e6)
    return VirtualRadio(bus, link, lead_ns, round(scenario["frame_period_s"] * 1e9))
