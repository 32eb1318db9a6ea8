"""The replay section of a scenario."""

from __future__ import annotations

from pydantic import Field

from protocol.config import Section


class ReplayConfig(Section):
    """What is played in the place of the world and the agents."""

    tape: str = Field(description="an MCAP file, or a run folder with one")
    speed: float = Field(
        1.0, gt=0, le=100, description="realtime: how many times as fast as it was recorded"
    )
    damaged: int = Field(0, ge=0, description="parts of the tape that cannot be read: told once")
