"""The lines for `tc -batch` that shape a link."""

from __future__ import annotations

from link_relay.netns.place import UPLINK
from sensing.link.path import HEADER_BYTES, SEGMENT_BYTES

MTU = SEGMENT_BYTES + HEADER_BYTES
_FRAME_BYTES = MTU + 14  # tbf counts the header of Ethernet, a profile's rate does not
_LATE_NS = 1_000_000  # a timer that fires so late does not slow the link
_LEAST_BPS = 1000  # tbf knows no rate 0; in 100 ms this is 12 bytes
_QUEUE_BYTES = 4 << 20  # never full: a sender's buffer holds less


def tbf(verb: str, rate_bps: int, held_ns: int) -> str:
    """Returns the line that lets IP packets pass at a rate that is held for so long.

    tbf fills its bucket when it is changed. What that lets through comes off the rate; while
    something waits, half a packet is in the bucket on the average, and is not given twice.

    Args:
        verb: `add` or `change`.
        rate_bps: of the link, in bit/s of IP packets; 0 is no connection.
        held_ns: until the next change.
    """
    frames_bps = rate_bps * _FRAME_BYTES // MTU
    burst = _FRAME_BYTES + frames_bps * _LATE_NS // 8_000_000_000
    given_bps = (burst - _FRAME_BYTES // 2) * 8_000_000_000 // held_ns
    kept_bps = max(_LEAST_BPS, frames_bps - given_bps)
    return (
        f"qdisc {verb} dev {UPLINK} root handle 1: "
        f"tbf rate {kept_bps}bit burst {burst} limit {_QUEUE_BYTES}"
    )


def delay_of_agent(verb: str, delay_us: int) -> str:
    """Returns the line that delays what the agent sends, before it is its turn."""
    return f"qdisc {verb} dev {UPLINK} parent 1:1 handle 10: netem delay {delay_us}us limit 10000"


def delay_of_host(verb: str, device: str, delay_us: int) -> str:
    """Returns the line that delays what the edge sends to an agent."""
    return f"qdisc {verb} dev {device} root netem delay {delay_us}us limit 10000"
