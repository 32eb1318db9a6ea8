"""Link budget: warns before a run starts if a whole scan cannot meet the edge's deadline."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from protocol.traffic import on_air_bytes
from sensing.config import LidarConfig, UploadConfig
from sensing.link_config import LinkConfig
from sensing.link_profile import LinkProfile, TraceRate
from sensing.radio import ENVELOPE_BYTES, AgentKind
from sensing.upload_policies import policy_of

# Of scans at the built-in junction (docs/uplink.md, docs/codec.md): they estimate, nothing more.
_BITS_A_BEAM = 2.3  # at an error of 2 cm, the sky's beams included
_BITS_A_DOUBLING = 0.9  # that twice the error saves
_LEAST_BITS = 0.3
_FOREGROUND_SHARE = 0.21  # of a scan's bytes


def link_warnings(scenario: dict[str, Any]) -> Iterator[str]:
    """Yields a sentence for each kind of agent whose whole scan misses the edge's deadline.

    The link's mean rate and median round trip count; a link that varies misses it more often.
    """
    link = LinkConfig.of(scenario)
    if link.channel(scenario["mode"]) == "none":
        return
    profiles: tuple[tuple[AgentKind, LinkProfile | None], ...] = (
        ("vehicle", link.profile),
        ("roadside", link.roadside_profile),
    )
    for kind, profile in profiles:
        chosen = UploadConfig.model_validate(scenario["upload"]).of(kind)
        policy = policy_of(chosen.policy)
        if profile is None or policy.sends != "scan" or policy.cells:
            continue
        deadline_ms = float(scenario["edge"]["deadline_ms"]) - link.agent_compute_ms
        is_filtered = "foreground" in {*chosen.filters, *policy.filters}
        size_bytes = scan_bytes(scenario, kind, is_filtered=is_filtered)
        if text := _warning(profile, size_bytes, deadline_ms, is_filtered=is_filtered):
            yield f"{kind}: {text}"


def scan_bytes(scenario: dict[str, Any], kind: AgentKind, *, is_filtered: bool) -> int:
    """Estimates the bytes of a message with a whole scan."""
    lidar = LidarConfig.model_validate(scenario["lidar"][kind])
    error_m = float(scenario["upload"]["max_error_m"])
    bits = max(_LEAST_BITS, _BITS_A_BEAM - _BITS_A_DOUBLING * math.log2(error_m / 0.02))
    bits *= _FOREGROUND_SHARE if is_filtered else 1.0
    return round(lidar.channels * lidar.columns * bits / 8) + ENVELOPE_BYTES


def _warning(
    profile: LinkProfile, size_bytes: int, deadline_ms: float, *, is_filtered: bool
) -> str:
    rate = profile.rate
    mbps = rate.mean_bps / 1e6 if isinstance(rate, TraceRate) else rate.mean_mbps
    way_ms, sending_ms = profile.rtt.median_ms / 2, on_air_bytes(size_bytes) * 8e-3 / mbps
    if way_ms + sending_ms <= deadline_ms:
        return ""
    left_ms = deadline_ms - way_ms
    text = (
        f"a whole scan of about {size_bytes / 1e3:.1f} kB takes {sending_ms:.0f} ms at "
        f"{mbps:g} Mbit/s and {way_ms:g} ms on its way, more than edge.deadline_ms leaves "
        f"({deadline_ms:g} ms): it will be left out of its frame. "
    )
    if left_ms <= 0:
        return text + f"No rate helps: the deadline must be longer than {way_ms:g} ms"
    fits = [
        f"{on_air_bytes(size_bytes) * 8e-3 / left_ms:.2g} Mbit/s",
        f"{mbps * left_ms / 8 * size_bytes / on_air_bytes(size_bytes):.1f} kB",
        f"a deadline of {math.ceil(way_ms + sending_ms)} ms",
    ]
    more = "" if is_filtered else f" (upload.filters=[foreground]: about {_FOREGROUND_SHARE:.0%})"
    return text + f"What would fit: {fits[0]}, {fits[1]}{more}, or {fits[2]}"
