"""The shape of a PointPillars network. Chen et al. 2022's is `FULL`; `SMALL` is for a CPU."""

from __future__ import annotations

from pydantic import Field, model_validator

from protocol.config import Section

FEATURES = 6  # of a point: height, offset from its pillar's mean (3) and middle (2)
STRIDE = 2  # cells of the pseudo-image for a cell of the output, each way
ANCHOR_YAWS = 2  # along x, and along y


class PillarsConfig(Section):
    """Grid, widths and anchors; it travels with the weights."""

    cell_m: float = Field(0.25, gt=0.05, le=1, description="side of a pillar")
    low_m: float = Field(-1.0, ge=-5, le=0, description="lowest point, over the road's height")
    high_m: float = Field(3.0, gt=0, le=10, description="highest point, over the road's height")
    pillar_channels: int = Field(16, ge=8, le=128, description="features of a pillar")
    channels: tuple[int, int, int] = Field((32, 64, 96), description="of the three blocks")
    layers: tuple[int, int, int] = Field(
        (1, 2, 2), description="convolutions of each block after its first, which halves the image"
    )
    up_channels: int = Field(32, ge=8, le=256, description="each block's share of the head's input")
    anchor_m: tuple[float, float, float] = Field(
        (4.4, 1.7, 1.7), description="length, width and height of the anchor"
    )
    middle_m: float = Field(0.85, description="height of the anchor's middle over the road")

    @model_validator(mode="after")
    def _sound(self) -> PillarsConfig:
        widths = (*self.channels, *(n + 1 for n in self.layers))
        if not all(1 <= n <= 1024 for n in widths) or min(self.anchor_m) <= 0:
            raise ValueError("channels must be 1 to 1024, layers from 0, anchors larger than 0")
        return self


SMALL = PillarsConfig()
FULL = PillarsConfig(pillar_channels=64, channels=(64, 128, 256), layers=(3, 5, 5), up_channels=128)
NETWORKS = {"pointpillars": SMALL, "pointpillars-full": FULL}
