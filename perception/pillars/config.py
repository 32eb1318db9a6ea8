"""The shape of a PointPillars network. Chen et al. 2022's is `FULL`; `SMALL` is for a CPU."""

from __future__ import annotations

import numpy as np
from pydantic import Field, model_validator

from perception.arrays import Bytes, Floats
from protocol.config import Section
from protocol.messages import ObjectClass

FEATURES = 6  # of a point: height, offset from its pillar's mean (3) and middle (2)
STRIDE = 2  # cells of the pseudo-image for a cell of the output, each way
ANCHOR_YAWS = 2  # along x, and along y


class Anchor(Section):
    """A box that stands in every cell, both ways, for objects of one class."""

    object_class: ObjectClass = Field(ObjectClass.CAR, description="what it is an anchor for")
    size_m: tuple[float, float, float] = Field(
        (4.4, 1.7, 1.7), description="length, width and height"
    )
    middle_m: float = Field(0.85, description="height of its middle over the road")
    object_iou: float = Field(
        0.6, gt=0, lt=1, description="training: overlap from which it is an object"
    )
    nothing_iou: float = Field(
        0.45, gt=0, lt=1, description="training: overlap up to which it is nothing"
    )

    @model_validator(mode="after")
    def _sound(self) -> Anchor:
        if min(self.size_m) <= 0 or self.nothing_iou > self.object_iou:
            raise ValueError("an anchor's sizes must be larger than 0, nothing_iou the lesser IoU")
        return self


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
    anchors: tuple[Anchor, ...] = Field((Anchor(),), min_length=1, max_length=16)

    @property
    def kinds(self) -> int:
        """How many anchors stand in a cell: each both ways."""
        return ANCHOR_YAWS * len(self.anchors)

    def sizes_m(self) -> Floats:
        """Returns the length, width and height of each kind of anchor (K, 3)."""
        return np.repeat([anchor.size_m for anchor in self.anchors], ANCHOR_YAWS, axis=0)

    def middles_m(self) -> Floats:
        """Returns the height over the road of each kind's middle (K,)."""
        return np.repeat([anchor.middle_m for anchor in self.anchors], ANCHOR_YAWS)

    def classes(self) -> Bytes:
        """Returns the `ObjectClass` of each kind (K,)."""
        found = np.array([anchor.object_class for anchor in self.anchors], np.uint8)
        return np.repeat(found, ANCHOR_YAWS)

    @model_validator(mode="after")
    def _sound(self) -> PillarsConfig:
        widths = (*self.channels, *(n + 1 for n in self.layers))
        if not all(1 <= n <= 1024 for n in widths):
            raise ValueError("channels must be 1 to 1024, layers from 0")
        return self


# Sizes: means of the training data. IoU as Lang et al. 2019 for cars; lower where lengths differ
# much, or where an anchor's cell is as large as the object.
_ANCHORS = (
    Anchor(size_m=(4.6, 1.85, 1.7)),
    Anchor(
        object_class=ObjectClass.TRUCK,
        size_m=(10.0, 2.5, 3.4),
        middle_m=1.7,
        object_iou=0.5,
        nothing_iou=0.35,
    ),
    Anchor(
        object_class=ObjectClass.TWO_WHEELER,
        size_m=(1.9, 0.7, 1.7),
        object_iou=0.4,
        nothing_iou=0.2,
    ),
    Anchor(
        object_class=ObjectClass.PEDESTRIAN,
        size_m=(0.6, 0.6, 1.7),
        object_iou=0.3,
        nothing_iou=0.15,
    ),
)
SMALL = PillarsConfig(high_m=4.2, anchors=_ANCHORS)
FULL = PillarsConfig(
    high_m=4.2,
    pillar_channels=64,
    channels=(64, 128, 256),
    layers=(3, 5, 5),
    up_channels=128,
    anchors=_ANCHORS,
)
NETWORKS = {"pointpillars": SMALL, "pointpillars-full": FULL}
