"""Configuration of tracking: the scenario's section `edge.tracking`."""

from __future__ import annotations

from pydantic import Field

from protocol.config import Section


class TrackingConfig(Section):
    """When a track begins, what it follows, how long it is kept without a detection."""

    enabled: bool = Field(
        True,
        description="ours: vehicles keep an id, have a speed, and stay known while nobody sees "
        "them; without, each frame stands for itself, as in the paper, and nobody is queued",
    )
    birth_score: float = Field(
        0.1,
        ge=0,
        le=1,
        description="a new track of a detection with at least this score is published at once, "
        "others once they are confirmed",
    )
    confirm_hits: int = Field(
        2, ge=1, le=100, description="detections after which a track is confirmed, and may coast"
    )
    gate: float = Field(
        9.0,
        gt=0,
        le=100,
        description="a detection at a larger squared Mahalanobis distance is not the track's",
    )
    accel_std_mps2: float = Field(
        2.5, gt=0, le=20, description="how much a vehicle that is seen changes its speed in 1 s"
    )
    coast_accel_std_mps2: float = Field(
        0.5,
        gt=0,
        le=20,
        description="the same on a lane while nobody sees it, beside what the "
        "vehicle ahead makes it do",
    )
    turn_std_rps: float = Field(
        0.3, gt=0, le=3, description="how much a vehicle changes its yaw rate in 1 s"
    )
    empty_life_s: float = Field(
        0.3,
        gt=0,
        description="mean life of a track whose place is in plain view and which is not detected; "
        "it is not published meanwhile, and keeps its id if it was missed by mistake",
    )
    shadow_life_s: float = Field(
        120.0, gt=0, description="mean life of a track where no sensor looks"
    )
    blind_life_s: float = Field(
        1.0, gt=0, description="the same where nothing says what sensors have seen"
    )
    min_existence: float = Field(
        0.01, gt=0, lt=1, description="a track that exists with less probability ends"
    )
    publish_probability: float = Field(
        0.4,
        gt=0,
        lt=1,
        description="a track that coasts is published while a vehicle is where it says with this "
        "probability: while it exists and its position is known to about half a car",
    )
    max_coast_s: float = Field(300.0, gt=0, le=3600, description="no track coasts longer")
    max_tracks: int = Field(
        1024,
        ge=1,
        le=4096,
        description="and detections of a frame; of more, those of a low score are left out",
    )
