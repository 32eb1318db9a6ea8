"""The fields that messages share, each within its bounds."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, FailFast, Field

from protocol.arrays import BoxRows, PoseRow, PoseRows, SiteRows, WeightRows

MAX_ITEMS = 4096  # of a list or map
_AGENT_BYTES = 128
_REACH = np.array([1e7, 1e7, 1e7, 1e3, 1e3, 1e3])  # m, rad: farther than any map


def _within_reach(poses: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if not (np.abs(poses) <= _REACH).all():
        raise ValueError("a pose lies beyond 1e7 m or 1e3 rad")
    return poses


def _on_the_map(sites: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if not (np.abs(sites) <= _REACH[0]).all():
        raise ValueError("a site lies beyond 1e7 m")
    return sites


def _moderate(weights_m2: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if not (np.abs(weights_m2) <= _REACH[0] ** 2).all():
        raise ValueError("a weight lies beyond 1e14 m^2")
    return weights_m2


def _short(agent: str) -> str:
    if len(agent) * 4 > _AGENT_BYTES and len(agent.encode()) > _AGENT_BYTES:
        raise ValueError(f"an agent's id takes more than {_AGENT_BYTES} bytes")
    return agent


def _plausible(boxes: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    if len(boxes) > MAX_ITEMS:
        raise ValueError(f"{len(boxes)} boxes, limit {MAX_ITEMS}")
    if not (np.abs(boxes) <= _REACH[0]).all():
        raise ValueError("a number of a box lies beyond 1e7")
    return boxes


# Whoever shows a text may show it on a terminal, which obeys control characters. A pattern costs
# least: pydantic looks for it without calling Python.
_SEEN = r"^[^\x00-\x1f\x7f-\x9f]*$"
Id = Annotated[str, Field(min_length=1, max_length=128, pattern=_SEEN)]
AgentId = Annotated[Id, AfterValidator(_short)]  # many of them must fit into one message
NetId = Annotated[
    str, Field(min_length=1, max_length=512, pattern=_SEEN)  # joined junctions have long ones
]
Text = Annotated[str, Field(max_length=512, pattern=_SEEN)]
Lights = Annotated[str, Field(max_length=512, pattern="^[GgyYrRsuoO]*$")]  # a letter a link
FrameNumber = Annotated[int, Field(ge=0, lt=1 << 40)]
Count = Annotated[int, Field(ge=0, lt=1 << 40)]
Total = Annotated[int, Field(ge=0, lt=1 << 53)]
TimeNs = Annotated[int, Field(gt=-(1 << 62), lt=1 << 62)]  # so that differences fit into 64 bit
Sites = Annotated[SiteRows, AfterValidator(_on_the_map)]
Borders = Annotated[WeightRows, AfterValidator(_moderate)]
Boxes = Annotated[BoxRows, AfterValidator(_plausible)]
Pose = Annotated[PoseRow, AfterValidator(_within_reach)]
Poses = Annotated[PoseRows, AfterValidator(_within_reach)]
BOUNDED = (FailFast(), Field(max_length=MAX_ITEMS))  # one error will do, a million cost memory
Ids = Annotated[list[Id], *BOUNDED]
Texts = Annotated[list[Text], *BOUNDED]
MAX_DELAY_NS = 60_000_000_000
NEVER_NS = (1 << 62) - 1  # the arrival of what a virtual link was not given any more
DelayNs = Annotated[int, Field(ge=0, le=MAX_DELAY_NS)]


class Equipment(IntEnum):
    """What a vehicle carries: nothing, a LiDAR and a radio, or a radio alone."""

    NONE = 0
    CAV = 1
    CV = 2
