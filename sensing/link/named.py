"""From what a user writes to a profile: a built-in name, a rate, or a trace file."""

from __future__ import annotations

import re
from pathlib import Path

from protocol.errors import ConfigError
from protocol.files import is_file
from sensing.link.builtin import BUILTIN
from sensing.link.files import read_trace
from sensing.link.profile import LinkProfile, RoundTrip, VaryingRate

NONE = "none"
_FIXED = re.compile(
    r"(?P<rate>[0-9]+(?:\.[0-9]+)?)(?P<unit>k|m|g)bit(?:/s)?(?:,(?P<rtt>[0-9]+(?:\.[0-9]+)?)ms)?",
    re.IGNORECASE,
)
_MBPS = {"k": 1e-3, "m": 1.0, "g": 1e3}


def profile_named(text: str) -> LinkProfile | None:
    """Reads `none`, a built-in name, `5mbit`, `5mbit,20ms` (rate, round trip) or a trace file.

    Raises:
        ConfigError: it is none of these, or the file cannot be read.
    """
    if text == NONE:
        return None
    if text in BUILTIN:
        return BUILTIN[text]
    if match := _FIXED.fullmatch(text):
        return _fixed(text, match)
    if not is_file(text):
        raise ConfigError(
            f"link {text!r:.80}: neither a file, nor a rate such as 5mbit or 5mbit,20ms (rate and "
            f"round trip), nor one of {', '.join([NONE, *BUILTIN])}"
        )
    return read_trace(Path(text))


def _fixed(text: str, match: re.Match[str]) -> LinkProfile:
    mbps, rtt_ms = float(match["rate"]) * _MBPS[match["unit"].lower()], float(match["rtt"] or 0)
    if not (0.001 <= mbps <= 100_000 and rtt_ms <= 60_000):
        raise ConfigError(
            f"link {text!r:.80}: the rate must be 1kbit to 100gbit, the round trip at most 60000ms"
        )
    return LinkProfile(
        name=text[:80],
        source="asked for by the user",
        rate=VaryingRate(mean_mbps=mbps),
        rtt=RoundTrip.steady(rtt_ms),
    )
