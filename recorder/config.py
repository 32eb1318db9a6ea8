"""What of a run is kept."""

from pydantic import Field

from protocol.config import Section


class RecordConfig(Section):
    """Counts, phases, trips, uploads and stages are always kept; these are the large ones."""

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
    tape: bool = Field(
        False,
        description="Keep all that was said on both buses in run.mcap too, so that it can be "
        "played again; needs the extra tape. Without truth as above.",
    )
    foxglove: bool = Field(
        True,
        description="On the tape, also write poses, boxes and as many clouds as there is time for "
        "in Foxglove's schemas.",
    )
