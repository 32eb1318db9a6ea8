"""The edge server's part of a scenario. Defaults are those of Chen et al. 2022, ours are marked."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from perception.config import DetectionConfig
from perception.tracking.config import TrackingConfig
from protocol.config import Section
from protocol.plugins import Catalogue, PluginSettings

FUSIONS = Catalogue("cpnet.fusions", "fusion", ("oriented", "radius"))
MergeMethod = Literal["se3", "euler"]


class FusionConfig(Section):
    """When two detections are one vehicle."""

    rule: Annotated[str, AfterValidator(FUSIONS.checked)] = Field(
        "oriented",
        description="oriented (ours): nearer than `duplicate_m` along the vehicle and `across_m` "
        "across it; radius: nearer than `duplicate_m`, as in the paper; or the name of a plug-in, "
        "beside which regions still join by `oriented` what several found",
    )
    plugin: PluginSettings = Field({})
    duplicate_m: float = Field(4.5, gt=0, le=20, description="a vehicle's length")
    across_m: float = Field(
        2.0, gt=0, le=5, description="ours: less than a lane, so that neighbours stay two"
    )


def check_fusion(config: FusionConfig) -> None:
    """Checks before a start that the fusion of a configuration can be loaded.

    Raises:
        ConfigError: the plug-in cannot be imported.
    """
    if config.rule not in FUSIONS.builtin:
        FUSIONS.load(config.rule)


class PlanConfig(Section):
    """Which agent uploads which part of the scene (EMP, 2021)."""

    alpha: float = Field(
        0.3,
        ge=0,
        le=0.4,
        description="reap: borders are drawn for uplink rates wrong by this share, either way",
    )
    nominal_mbps: float = Field(
        10.0, ge=0.1, le=1000, description="an uplink's rate as long as nothing was seen of it"
    )
    early_end: bool = Field(
        True,
        description="reap, realtime: a frame ends once the space between all neighbours is covered",
    )


class MisbehaviourConfig(Section):
    """Misbehaviour detection: which agents are excluded."""

    enabled: bool = Field(
        True, description="ours: agents whose data cannot be so are excluded; see reliability.md"
    )
    threshold: float = Field(
        0.4,
        gt=0,
        lt=0.8,
        description="an agent whose score falls below this is excluded until it is 0.2 higher",
    )


class EdgeConfig(DetectionConfig):
    """The edge server: how long it waits, how it merges, detects and counts."""

    deadline_ms: float = Field(
        80.0,
        gt=0,
        le=10_000,
        description="realtime: a frame waits so long after its first arrival; lockstep with "
        "virtual links: what arrives later than this after the frame's time is left out",
    )
    lockstep_timeout_s: float = Field(
        20.0, gt=0, le=600, description="lockstep: the same, only for agents that hang"
    )
    border_wait_ms: float = Field(
        20.0,
        gt=0,
        le=10_000,
        description="realtime: a frame waits so long for what neighbouring regions found",
    )
    merge: MergeMethod = Field(
        "se3",
        description="se3: exact transforms; euler: differences of Euler angles, as in the paper",
    )
    alignment: Literal["none", "map"] = Field(
        "none",
        description="ours. map: scans are registered to a static map of the scene that the edge "
        "learns; agents' poses are corrected by what they are off",
    )
    upstream_m: float = Field(200.0, gt=0, description="vehicles so far before the stop bar count")
    downstream_m: float = Field(100.0, ge=0, description="vehicles so far behind it count")
    coverage_range_m: float = Field(
        100.0,
        gt=0,
        le=500,
        description="ours: how far a LiDAR detects vehicles reliably; the part of a lane that is "
        "farther from all LiDARs is published to the controller as not covered",
    )
    stationary_mps: float = Field(
        1.4, gt=0, le=10, description="ours: a slower vehicle counts as queued; 5 km/h"
    )
    plan: PlanConfig = Field(PlanConfig(), description="who uploads which part of the scene")
    fusion: FusionConfig = Field(FusionConfig(), description="duplicates")
    tracking: TrackingConfig = Field(
        TrackingConfig(), description="vehicles followed from frame to frame"
    )
    misbehaviour: MisbehaviourConfig = Field(
        MisbehaviourConfig(), description="which agents are excluded"
    )
