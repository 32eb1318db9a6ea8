"""Built-in link profiles, each with its source.

Where a source gives no fluctuation or no tail, the figure is this project's choice and says so.
"""

from __future__ import annotations

from sensing.link.profile import LinkProfile, Outages, RoundTrip, VaryingRate

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
