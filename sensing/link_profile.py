"""Link profiles: rate over time, round trip and outages of an uplink; the built-in ones.

Each built-in profile names its source. Where a source gives no fluctuation or no tail, the figure
is this project's choice, stated as such.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from protocol.config import Section
from sensing.limits import (
    MAX_BURST,
    MAX_LOST_SHARE,
    MAX_PERIOD_US,
    MAX_RATE_BPS,
    MAX_RTT_US,
    MAX_STEPS,
    MIN_MEAN_BPS,
    MIN_STEP_US,
)


class VaryingRate(Section):
    """A rate drawn by seed and agent: log-normal around its mean, correlated in time."""

    kind: Literal["varying"] = Field("varying", description="a rate drawn by seed")
    mean_mbps: float = Field(10.0, ge=0.001, le=100_000, description="mean uplink rate, Mbit/s")
    variation: float = Field(
        0.0, ge=0, le=3, description="standard deviation over mean; 0 for a fixed rate"
    )
    correlation_s: float = Field(
        1.0, gt=0, le=600, description="time in which its correlation falls to 1/e"
    )


class TraceRate(Section):
    """A recorded rate; it repeats after `period_us`. Rates are of IP packets, headers included."""

    kind: Literal["trace"] = Field("trace", description="a recorded rate")
    starts_us: list[int] = Field(
        [0], min_length=1, max_length=MAX_STEPS, description="when each rate begins; ascending"
    )
    rates_bps: list[int] = Field(
        [10_000_000], min_length=1, max_length=MAX_STEPS, description="as many, in bit/s"
    )
    rtt_us: list[int] = Field(
        [], max_length=MAX_STEPS, description="round trips, as many; empty for none"
    )
    period_us: int = Field(1_000_000, gt=0, description="when it repeats")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.rates_bps) != len(self.starts_us):
            raise ValueError(
                f"rates_bps has {len(self.rates_bps)} entries, needs {len(self.starts_us)}"
            )
        if self.rtt_us and len(self.rtt_us) != len(self.starts_us):
            raise ValueError(f"rtt_us has {len(self.rtt_us)} entries, needs {len(self.starts_us)}")
        _check_times([*self.starts_us, self.period_us])
        _check_limits("rates_bps", self.rates_bps, MAX_RATE_BPS)
        _check_limits("rtt_us", self.rtt_us, MAX_RTT_US)
        if self.mean_bps < MIN_MEAN_BPS:
            raise ValueError(f"the mean rate is {self.mean_bps:g} bit/s, needs {MIN_MEAN_BPS}")
        return self

    @property
    def mean_bps(self) -> float:
        """The mean rate over the period."""
        spans_us = (b - a for a, b in pairwise([*self.starts_us, self.period_us]))
        bits = sum(us * bps for us, bps in zip(spans_us, self.rates_bps, strict=True))
        return bits / self.period_us


def _check_times(edges_us: list[int]) -> None:
    if edges_us[-1] > MAX_PERIOD_US:
        raise ValueError(
            f"the trace repeats after {edges_us[-1] / 1e6:g} s, limit {MAX_PERIOD_US / 1e6:g}"
        )
    if edges_us[0] != 0 or any(b - a < MIN_STEP_US for a, b in pairwise(edges_us)):
        raise ValueError(
            "starts_us must begin with 0 and ascend to period_us, "
            f"by {MIN_STEP_US} (1 ms) or more each"
        )


def _check_limits(name: str, values: list[int], most: int) -> None:
    if values and not 0 <= min(values) <= max(values) <= most:
        raise ValueError(f"{name} are from {min(values)} to {max(values)}, allowed: 0 to {most}")


class RoundTrip(Section):
    """The round trip of a small packet on an idle link; one half of it each way."""

    median_ms: float = Field(0.0, ge=0, le=60_000, description="half of all are faster")
    p95_ms: float = Field(0.0, ge=0, le=60_000, description="95 of 100 are faster")
    p99_ms: float = Field(0.0, ge=0, le=60_000, description="99 of 100 are faster")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.median_ms <= self.p95_ms <= self.p99_ms:
            raise ValueError(
                f"median {self.median_ms:g}, p95 {self.p95_ms:g} and p99 {self.p99_ms:g} ms "
                "must not descend"
            )
        return self

    @classmethod
    def steady(cls, rtt_ms: float) -> RoundTrip:
        """Returns a round trip without jitter."""
        return cls(median_ms=rtt_ms, p95_ms=rtt_ms, p99_ms=rtt_ms)


class Outages(Section):
    """When the connection is lost: what is sent meanwhile waits."""

    per_minute: float = Field(0.0, ge=0, le=60, description="losses per minute of connection")
    mean_s: float = Field(1.0, gt=0, le=60, description="mean length; lengths are exponential")


class PacketLoss(Section):
    """Loss of an uplink's packets by a chain of two states, which moves with each packet.

    Gilbert, Bell Syst. Tech. J. 39 (1960), and Elliott, ibid. 42 (1963); in `tc netem` it is
    `loss gemodel p r 1-h 1-k`: `good_to_bad`, `bad_to_good`, `loss_in_bad`, `loss_in_good`.
    Without `good_to_bad` packets are lost independently.
    """

    good_to_bad: float = Field(0.0, ge=0, le=1, description="probability p, at each packet")
    bad_to_good: float = Field(
        1.0, ge=1 / MAX_BURST, le=1, description="probability r, at each packet"
    )
    loss_in_bad: float = Field(1.0, ge=0, le=1, description="share of packets lost, 1 - h")
    loss_in_good: float = Field(0.0, ge=0, le=0.5, description="share of packets lost, 1 - k")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.share > MAX_LOST_SHARE:
            raise ValueError(
                f"{self.share:.3g} of all packets are lost, allowed: {MAX_LOST_SHARE}, for TCP "
                "passes hardly anything then"
            )
        return self

    @property
    def share(self) -> float:
        """The share of all packets that are lost."""
        bad = self.good_to_bad / (self.good_to_bad + self.bad_to_good)
        return bad * self.loss_in_bad + (1 - bad) * self.loss_in_good

    @classmethod
    def independent(cls, share: float) -> PacketLoss:
        """Returns loss of a share of all packets, each by itself."""
        return cls(loss_in_good=share)

    @classmethod
    def in_bursts(cls, share: float, packets: float) -> PacketLoss:
        """Returns loss of a share of all packets, in bursts of so many on average (Gilbert)."""
        return cls(good_to_bad=share / (1 - share) / packets, bad_to_good=1 / packets)


class LinkProfile(Section):
    """A link profile; `source` names where its figures come from."""

    name: str = Field("own", min_length=1, max_length=80, description="as reports call it")
    source: str = Field("", description="where the figures come from")
    rate: VaryingRate | TraceRate = Field(
        VaryingRate(), discriminator="kind", description="of the uplink, IP headers included"
    )
    rtt: RoundTrip = Field(RoundTrip(), description="a trace's own round trip comes before it")
    outages: Outages = Field(Outages(), description="losses of connection")
    loss: PacketLoss = Field(PacketLoss(), description="packets lost, which TCP sends again")

    @field_validator("rate", mode="before")
    @classmethod
    def _default_kind(cls, value: object) -> object:
        return {"kind": "varying", **value} if isinstance(value, dict) else value


_SPROUT = (
    "mean uplink rate of the trace {trace} that comes with Mahimahi, recorded while driving with "
    "the Saturator of Winstein et al., Sprout, NSDI 2013; round trip: averages of 30 to 70 ms by "
    "network in OpenSignal's 2019 US report, tail chosen; variation and correlation chosen"
)

BUILTIN = {
    profile.name: profile
    for profile in (
        LinkProfile(
            name="5g-urban",
            source="round trip: drive tests in urban 5G, median 16, p95 22, p99 27 ms; rate and "
            "its variation chosen: tens of Mbit/s in a mid-band cell's uplink",
            rate=VaryingRate(mean_mbps=50, variation=0.4, correlation_s=2),
            rtt=RoundTrip(median_ms=16, p95_ms=22, p99_ms=27),
        ),
        LinkProfile(
            name="5g-weak",
            source="round trip: the same drive tests where the signal is weak, median 19, p95 34, "
            "p99 279 ms; rate, variation and outages chosen",
            rate=VaryingRate(mean_mbps=5, variation=0.8, correlation_s=2),
            rtt=RoundTrip(median_ms=19, p95_ms=34, p99_ms=279),
            outages=Outages(per_minute=0.5, mean_s=0.5),
        ),
        LinkProfile(
            name="lte",
            source=_SPROUT.format(trace="Verizon-LTE-short.up (6 Mbit/s)"),
            rate=VaryingRate(mean_mbps=6, variation=0.5, correlation_s=1),
            rtt=RoundTrip(median_ms=50, p95_ms=80, p99_ms=120),
        ),
        LinkProfile(
            name="lte-good",
            source=_SPROUT.format(trace="TMobile-LTE-short.up (14 Mbit/s)"),
            rate=VaryingRate(mean_mbps=14, variation=0.5, correlation_s=1),
            rtt=RoundTrip(median_ms=40, p95_ms=60, p99_ms=90),
        ),
        LinkProfile(
            name="lte-poor",
            source=_SPROUT.format(trace="ATT-LTE-driving.up (0.8 Mbit/s)"),
            rate=VaryingRate(mean_mbps=0.8, variation=0.7, correlation_s=1),
            rtt=RoundTrip(median_ms=60, p95_ms=120, p99_ms=250),
            outages=Outages(per_minute=1, mean_s=1),
        ),
    )
}
"""Profiles by name."""
