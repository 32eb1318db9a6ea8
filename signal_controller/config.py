"""The signal controller's part of a scenario."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from protocol.config import Section


class SignalConfig(Section):
    """Who decides on the phase; minimum green, yellow and all-red are the cabinet's."""

    policy: Literal["max_pressure", "fixed"] = Field(
        "max_pressure",
        description="max_pressure: the phase with most vehicles before it and fewest behind it, "
        "as in Chen et al. 2022; fixed: the plan that the net brings",
    )
    unseen: Literal["alike", "empty"] = Field(
        "alike",
        description="ours: what max_pressure makes of the part of a lane that no LiDAR has within "
        "sight (edge.sight_m): alike, it is as full as the rest of the lane; empty, as in Chen et "
        "al. 2022",
    )
    weight: Literal["vehicles", "queued"] = Field(
        "vehicles",
        description="what max_pressure counts: vehicles, as in Chen et al. 2022, or those that "
        "stand still (edge.standing_mps); how far from the stop bar, edge.upstream_m and "
        "edge.downstream_m say",
    )
