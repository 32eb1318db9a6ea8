"""The columns of a study's table that are not its axes."""

from __future__ import annotations

MEASURES = frozenset(
    {
        "frames",
        "e_cvpr",
        "e_cvpr_std",
        "e_cvpr_hist",
        "visible_share",
        "in_range_share",
        "present",
        "false_detections",
        "count_error",
        "count_bias",
        "delay_s",
        "delay_std_s",
        "switches",
        "vehicles_at_start",
        "vehicles_inserted",
        "vehicles_finished",
        "vehicles_teleported",
        "vehicles_waiting",
        "uplink_mbps",
        "uplink_peak_mbps",
    }
)
"""What `studies.measures.measure` gives."""

LISTS = frozenset({"e_cvpr_hist"})
RESERVED = frozenset({"grid", "seed", "n"}) | MEASURES
"""What no axis may be called; nor by a measure's name with an end, such as delay_s_mean."""


def is_taken(name: str) -> bool:
    """Whether a column of this name is the table's own."""
    stems = (name.removeprefix("_").rpartition("_")[0], name)
    return name in RESERVED or any(stem in MEASURES for stem in stems)
