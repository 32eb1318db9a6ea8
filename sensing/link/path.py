"""A profile made real for one agent: exact rate and delay at every moment, from seed and agent."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sensing.link.profile import LinkProfile, Outages, TraceRate, VaryingRate
from sensing.link.steps import Interrupted, Steps
from sensing.noise import stream

SEGMENT_BYTES = 1448  # of payload in a packet of 1500 bytes: TCP over IPv4 with time stamps
HEADER_BYTES = 52
_DRAWN_NS = 600_000_000_000  # what is drawn repeats after ten minutes
_STEP_NS = 100_000_000  # rate and delay keep for this long: coherence of a fading channel


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Bit rate and round trip over time; time 0 is the link's own."""

    rate_bps: Steps | Interrupted
    rtt_ns: Steps

    @classmethod
    def draw(cls, profile: LinkProfile, seed: int, agent: str) -> Path:
        """Returns the path of an agent; the same for the same arguments, on any machine."""
        rate = profile.rate
        bps: Steps | Interrupted
        if isinstance(rate, TraceRate):
            bps = _steps(rate, rate.rates_bps)
        else:
            bps = _varying(rate, stream(seed, "link rate", agent))
        if profile.outages.per_minute:
            bps = _interrupted(bps, profile.outages, stream(seed, "link outages", agent))
        if isinstance(rate, TraceRate) and rate.rtt_us:
            return cls(bps, _steps(rate, [rtt_us * 1000 for rtt_us in rate.rtt_us]))
        return cls(bps, _round_trips(profile, stream(seed, "link delay", agent)))

    def departure_ns(self, start_ns: int, size_bytes: int) -> int:
        """Returns when the last bit of a TCP payload is on the link if its first is at the start.

        The headers of its packets take their share of the rate.
        """
        bits = 8 * on_air_bytes(size_bytes)
        return self.rate_bps.reach(start_ns, bits * 1_000_000_000)

    def bytes_in(self, start_ns: int, span_ns: int) -> int:
        """Returns how many bytes the link takes in a span, headers included."""
        return self.rate_bps.integral(start_ns, start_ns + span_ns) // 8_000_000_000

    def arrival_ns(self, start_ns: int, departure_ns: int) -> int:
        """Returns when all of a message has arrived that leaves bit by bit between these times.

        No packet overtakes another: one that left while the round trip was long holds up others;
        one that left longer ago than the longest delay no longer does.
        """
        arrival_ns = departure_ns + self.delay_ns(departure_ns)
        since_ns = max(start_ns, arrival_ns - self.rtt_ns.largest // 2)
        for change_ns in self.rtt_ns.changes(since_ns, departure_ns):
            last_ns = change_ns - 1
            if last_ns >= start_ns and self.rate_bps.at(last_ns) > 0:
                arrival_ns = max(arrival_ns, last_ns + self.delay_ns(last_ns))
        return arrival_ns

    def delay_ns(self, time_ns: int) -> int:
        """Returns how long a packet travels that departs then: one way."""
        return self.rtt_ns.at(time_ns) // 2


def on_air_bytes(size_bytes: int) -> int:
    """Returns what a TCP payload takes on the link, with the headers of TCP and IP."""
    return size_bytes + HEADER_BYTES * -(-size_bytes // SEGMENT_BYTES)


def _steps(rate: TraceRate, values: list[int]) -> Steps:
    return Steps([start_us * 1000 for start_us in rate.starts_us], values, rate.period_us * 1000)


def _varying(rate: VaryingRate, rng: np.random.Generator) -> Steps:
    mean_bps = rate.mean_mbps * 1e6
    if rate.variation == 0:
        return Steps.constant(round(mean_bps))
    count = _DRAWN_NS // _STEP_NS
    spread = math.sqrt(math.log1p(rate.variation**2))
    keep = math.exp(-_STEP_NS / 1e9 / rate.correlation_s)
    shocks = rng.standard_normal(count)
    level, levels = float(shocks[0]), []
    for shock in shocks:
        levels.append(level)
        level = keep * level + math.sqrt(1 - keep**2) * float(shock)
    rates = mean_bps * np.exp(spread * np.array(levels) - spread**2 / 2)
    starts_ns = [step * _STEP_NS for step in range(count)]
    return Steps(starts_ns, [max(1, round(bps)) for bps in rates.tolist()], _DRAWN_NS)


def _round_trips(profile: LinkProfile, rng: np.random.Generator) -> Steps:
    """Draws round trips whose quantiles are the profile's, linear between them.

    The fastest is 0.8 of the median; the tail goes as far beyond p99 as that is from p95.
    """
    rtt = profile.rtt
    if rtt.median_ms == rtt.p99_ms:
        return Steps.constant(round(rtt.median_ms * 1e6))
    longest_ms = 2 * rtt.p99_ms - rtt.p95_ms
    known_ms = [0.8 * rtt.median_ms, rtt.median_ms, rtt.p95_ms, rtt.p99_ms, longest_ms]
    count = _DRAWN_NS // _STEP_NS
    drawn_ms = np.interp(rng.random(count), [0, 0.5, 0.95, 0.99, 1], known_ms)
    starts_ns = [step * _STEP_NS for step in range(count)]
    return Steps(starts_ns, [round(ms * 1e6) for ms in drawn_ms.tolist()], _DRAWN_NS)


def _interrupted(rate: Steps, outages: Outages, rng: np.random.Generator) -> Interrupted:
    """Returns the rate with losses of connection in it, over ten minutes or a little more."""
    turns = -(-_DRAWN_NS // rate.period_ns)
    gone: list[tuple[int, int]] = []
    at_ns = 0
    while True:
        at_ns += max(1, round(rng.exponential(60e9 / outages.per_minute)))
        end_ns = at_ns + max(1, round(rng.exponential(outages.mean_s * 1e9)))
        if end_ns >= turns * rate.period_ns:
            return Interrupted(rate, gone, turns)
        gone.append((at_ns, end_ns))
        at_ns = end_ns
