"""The sections `record` and `replay` of a scenario."""

from __future__ import annotations

from pydantic import Field

from protocol.config import Section


class RecordConfig(Section):
    """What a run records besides counts, phases, trips, uploads and stages: the large tables."""

    snapshot_period_s: float = Field(
        10.0,
        ge=0,
        le=86_400,
        description="Keep every upload of one frame this often in simulated seconds, so that its "
        "cloud can be drawn later; 0 keeps none.",
    )
    truth: bool = Field(
        True,
        description="Keep where every vehicle truly was in each frame, and whose points lay on "
        "it; E-CVPR needs it. About 150 bytes per vehicle and frame.",
    )
    mcap: bool = Field(
        False,
        description="Keep all messages of both buses in run.mcap too, so that the run can be "
        "played again; needs the extra mcap. Without truth as above.",
    )


class ReplayConfig(Section):
    """The recording to replay instead of the world and the agents."""

    recording: str = Field(description="an MCAP file, or a run folder with one")
    speed: float = Field(
        1.0, gt=0, le=100, description="realtime: how many times as fast as it was recorded"
    )
    damaged: int = Field(
        0, ge=0, description="parts of the recording that cannot be read: told once"
    )
