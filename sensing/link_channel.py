"""Channel model: exact rate and delay of one agent's link over time, and a queue before it.

A channel is drawn from a profile by seed and agent. Times and amounts are integers, so that every
machine finds the same numbers.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, chain, pairwise

import numpy as np

from protocol.messages import MAX_DELAY_NS
from protocol.traffic import on_air_bytes
from sensing.link_profile import LinkProfile, Outages, TraceRate, VaryingRate
from sensing.noise import stream
from sensing.packet_loss import LossPattern


class StepFunction:
    """`values[i]` holds from `starts_ns[i]` until the next start; all repeats after `period_ns`.

    Times may be any integer: the pattern repeats in both directions.
    """

    def __init__(self, starts_ns: Sequence[int], values: Sequence[int], period_ns: int) -> None:
        ends_ns = [*starts_ns[1:], period_ns]
        if not starts_ns or starts_ns[0] != 0 or len(starts_ns) != len(values):
            raise ValueError("steps begin at 0 and have one value each")
        if any(a >= b for a, b in zip(starts_ns, ends_ns, strict=True)) or min(values) < 0:
            raise ValueError("steps ascend within the period and no value is negative")
        self.starts_ns = list(starts_ns)
        self.values = list(values)
        self.period_ns = period_ns
        spans = zip(self.starts_ns, ends_ns, self.values, strict=True)
        self._sums = [0, *accumulate((end - start) * value for start, end, value in spans)]
        self._total = self._sums[-1]
        self.largest = max(self.values)

    @classmethod
    def constant(cls, value: int) -> StepFunction:
        """Returns a function that never changes."""
        return cls([0], [value], 1_000_000_000)

    def at(self, time_ns: int) -> int:
        """Returns the value at a time."""
        return self.values[bisect_right(self.starts_ns, time_ns % self.period_ns) - 1]

    def changes(self, after_ns: int, until_ns: int) -> Iterator[int]:
        """Yields the starts of steps in (after, until], in their order."""
        turn, inside_ns = divmod(after_ns, self.period_ns)
        step = bisect_right(self.starts_ns, inside_ns)
        while True:
            if step == len(self.starts_ns):
                turn, step = turn + 1, 0
            start_ns = turn * self.period_ns + self.starts_ns[step]
            if start_ns > until_ns:
                return
            yield start_ns
            step += 1

    def integral(self, start_ns: int, end_ns: int) -> int:
        """Returns the integral, in value x ns."""
        return self._since_zero(end_ns) - self._since_zero(start_ns)

    def reach(self, start_ns: int, amount: int) -> int:
        """Returns the first whole ns at which the integral since the start is the amount or more.

        Raises:
            ValueError: all values are 0.
        """
        if amount <= 0:
            return start_ns
        if self._total == 0:
            raise ValueError("nothing ever passes: all values are 0")
        goal = self._since_zero(start_ns) + amount
        turns = (goal - 1) // self._total
        rest = goal - turns * self._total  # 1 to total: the first step that holds it is not 0
        step = bisect_left(self._sums, rest) - 1
        inside_ns = -((self._sums[step] - rest) // self.values[step])
        return turns * self.period_ns + self.starts_ns[step] + inside_ns

    def _since_zero(self, time_ns: int) -> int:
        turns, inside_ns = divmod(time_ns, self.period_ns)
        step = bisect_right(self.starts_ns, inside_ns) - 1
        into_ns = inside_ns - self.starts_ns[step]
        return turns * self._total + self._sums[step] + into_ns * self.values[step]


class InterruptedSteps:
    """Steps that are 0 within spans, [start, end) each, ascending and apart; it repeats in turns.

    A span costs the same whether the steps within it are one or a million.
    """

    def __init__(self, steps: StepFunction, gone: Sequence[tuple[int, int]], turns: int) -> None:
        self._steps = steps
        self.largest = steps.largest
        self.period_ns = turns * steps.period_ns
        self._starts_ns = [0, *(end_ns for _, end_ns in gone)]  # of what is left
        self._ends_ns = [*(start_ns for start_ns, _ in gone), self.period_ns]
        edges_ns = [0, *chain.from_iterable(gone), self.period_ns]
        if any(a > b for a, b in pairwise(edges_ns)):
            raise ValueError("spans ascend within the period")
        spans = zip(self._starts_ns, self._ends_ns, strict=True)
        self._sums = [0, *accumulate(steps.integral(start, end) for start, end in spans)]

    def at(self, time_ns: int) -> int:
        """Returns the value at a time."""
        inside_ns = time_ns % self.period_ns
        there = inside_ns < self._ends_ns[bisect_right(self._starts_ns, inside_ns) - 1]
        return self._steps.at(inside_ns) if there else 0

    def integral(self, start_ns: int, end_ns: int) -> int:
        """Returns the integral, in value x ns."""
        return self._since_zero(end_ns) - self._since_zero(start_ns)

    def reach(self, start_ns: int, amount: int) -> int:
        """See `StepFunction.reach`."""
        total = self._sums[-1]
        if amount <= 0:
            return start_ns
        if total == 0:
            raise ValueError("nothing ever passes: all values are 0")
        turns, rest = divmod(self._since_zero(start_ns) + amount - 1, total)
        span = bisect_right(self._sums, rest) - 1
        inside_ns = self._steps.reach(self._starts_ns[span], rest + 1 - self._sums[span])
        return turns * self.period_ns + inside_ns

    def _since_zero(self, time_ns: int) -> int:
        turns, inside_ns = divmod(time_ns, self.period_ns)
        span = bisect_right(self._starts_ns, inside_ns) - 1
        until_ns = min(inside_ns, self._ends_ns[span])
        since_start = self._steps.integral(self._starts_ns[span], until_ns)
        return turns * self._sums[-1] + self._sums[span] + since_start


_DRAWN_NS = 600_000_000_000  # what is drawn repeats after ten minutes
_STEP_NS = 100_000_000  # rate and delay keep for this long: coherence of a fading channel


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """Bit rate and round trip of one agent's link over time; time 0 is the link's own."""

    rate_bps: StepFunction | InterruptedSteps
    rtt_ns: StepFunction
    losses: LossPattern | None = None  # of the uplink; None where no packet is lost

    @classmethod
    def draw(cls, profile: LinkProfile, seed: int, agent: str) -> Channel:
        """Draws the channel of an agent; the same for the same arguments, on any machine."""
        rate = profile.rate
        bps: StepFunction | InterruptedSteps
        if isinstance(rate, TraceRate):
            bps = _trace_steps(rate, rate.rates_bps)
        else:
            bps = _varying(rate, stream(seed, "link rate", agent))
        if profile.outages.per_minute:
            bps = _interrupted(bps, profile.outages, stream(seed, "link outages", agent))
        losses = LossPattern(profile.loss, seed, agent) if profile.loss.share else None
        if isinstance(rate, TraceRate) and rate.rtt_us:
            rtt_ns = _trace_steps(rate, [rtt_us * 1000 for rtt_us in rate.rtt_us])
        else:
            rtt_ns = _round_trips(profile, stream(seed, "link delay", agent))
        return cls(bps, rtt_ns, losses)

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


def _trace_steps(rate: TraceRate, values: list[int]) -> StepFunction:
    return StepFunction(
        [start_us * 1000 for start_us in rate.starts_us], values, rate.period_us * 1000
    )


def _varying(rate: VaryingRate, rng: np.random.Generator) -> StepFunction:
    mean_bps = rate.mean_mbps * 1e6
    if rate.variation == 0:
        return StepFunction.constant(round(mean_bps))
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
    return StepFunction(starts_ns, [max(1, round(bps)) for bps in rates.tolist()], _DRAWN_NS)


def _round_trips(profile: LinkProfile, rng: np.random.Generator) -> StepFunction:
    """Draws round trips whose quantiles are the profile's, linear between them.

    The fastest is 0.8 of the median; the tail goes as far beyond p99 as that is from p95.
    """
    rtt = profile.rtt
    if rtt.median_ms == rtt.p99_ms:
        return StepFunction.constant(round(rtt.median_ms * 1e6))
    longest_ms = 2 * rtt.p99_ms - rtt.p95_ms
    known_ms = [0.8 * rtt.median_ms, rtt.median_ms, rtt.p95_ms, rtt.p99_ms, longest_ms]
    count = _DRAWN_NS // _STEP_NS
    drawn_ms = np.interp(rng.random(count), [0, 0.5, 0.95, 0.99, 1], known_ms)
    starts_ns = [step * _STEP_NS for step in range(count)]
    return StepFunction(starts_ns, [round(ms * 1e6) for ms in drawn_ms.tolist()], _DRAWN_NS)


def _interrupted(
    rate: StepFunction, outages: Outages, rng: np.random.Generator
) -> InterruptedSteps:
    """Returns the rate with losses of connection in it, over ten minutes or a little more."""
    turns = -(-_DRAWN_NS // rate.period_ns)
    gone: list[tuple[int, int]] = []
    at_ns = 0
    while True:
        at_ns += max(1, round(rng.exponential(60e9 / outages.per_minute)))
        end_ns = at_ns + max(1, round(rng.exponential(outages.mean_s * 1e9)))
        if end_ns >= turns * rate.period_ns:
            return InterruptedSteps(rate, gone, turns)
        gone.append((at_ns, end_ns))
        at_ns = end_ns


@dataclass(frozen=True, slots=True)
class Transmission:
    """Times of a message on a virtual link, in simulated time.

    It was queued at `sent_ns`, its first bit left at `left_ns` and its last at `gone_ns`.
    """

    sent_ns: int
    first_bit_ns: int
    last_bit_ns: int
    arrival_ns: int
    on_air_bytes: int

    @property
    def latency_ns(self) -> int:
        """Time in the queue and on the link."""
        return min(self.arrival_ns - self.sent_ns, MAX_DELAY_NS)


class VirtualLink:
    """A virtual link: a first-in, first-out queue before a channel, in simulated time."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._last: Transmission | None = None
        self._before: list[
            Transmission | None
        ] = []  # of those that may be recalled: the last one before it

    def send(self, now_ns: int, size_bytes: int, *, recallable: bool = False) -> Transmission:
        """Queues a message of so many bytes of TCP payload.

        Messages keep their order, also where a later one would have the shorter delay.
        """
        first_bit_ns = now_ns if self._last is None else max(now_ns, self._last.last_bit_ns)
        last_bit_ns = self._channel.departure_ns(first_bit_ns, size_bytes)
        arrival_ns = self._channel.arrival_ns(first_bit_ns, last_bit_ns)
        if self._last is not None:
            arrival_ns = max(arrival_ns, self._last.arrival_ns)
        if recallable:
            self._before.append(self._last)
        else:
            self._before.clear()
        self._last = Transmission(
            now_ns, first_bit_ns, last_bit_ns, arrival_ns, on_air_bytes(size_bytes)
        )
        return self._last

    def recall(self, time_ns: int) -> list[Transmission]:
        """Recalls recallable messages that had not begun to leave by then, the last one first.

        All others count as sent for good.
        """
        recalled = []
        while self._before and self._last is not None and self._last.first_bit_ns >= time_ns:
            recalled.append(self._last)
            self._last = self._before.pop()
        self._before.clear()
        return recalled

    def backlog_ns(self, now_ns: int) -> int:
        """Returns how long what is queued now will take to leave."""
        return 0 if self._last is None else max(0, self._last.last_bit_ns - now_ns)

    def delay_ns(self, time_ns: int) -> int:
        """Returns the one-way delay of a small message from the edge at a time."""
        return self._channel.delay_ns(time_ns)
