"""What tracking goes by: the scenario's section `edge.tracking`."""

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
