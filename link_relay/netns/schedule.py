"""A path in steps: what `tc` is told as time goes on."""

from __future__ import annotations

from sensing.link.path import Path

STEP_NS = 100_000_000  # of a drawn path's own rate and delay; what varies faster is averaged
MOST_STEPS = 100


def rate_bps(path: Path, step: int) -> int:
    """Returns the mean rate in a step, in bit/s of IP packets; 0 while there is no connection."""
    return path.rate_bps.integral(step * STEP_NS, (step + 1) * STEP_NS) // STEP_NS


def delay_us(path: Path, step: int) -> int:
    """Returns how long packets travel in a step: one way."""
    round_trip = path.rtt_ns.integral(step * STEP_NS, (step + 1) * STEP_NS) // STEP_NS
    return round_trip // 2000


def held_ns(path: Path, step: int) -> int:
    """Returns how long the rate stays as it is in this step, or at least that long."""
    rate = rate_bps(path, step)
    steps = 1
    while steps < MOST_STEPS and rate_bps(path, step + steps) == rate:
        steps += 1
    return steps * STEP_NS
