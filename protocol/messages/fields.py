"""The base of messages, and the fields that they share: arrays, ids, times, each within bounds.

An array's dtype and shape are declared once and checked by sender and receiver.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, FailFast, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from protocol.limits import (
    MAX_AGENT_ID_BYTES,
    MAX_ANGLE_RAD,
    MAX_BODIES,
    MAX_COASTED_S,
    MAX_COUNT,
    MAX_DELAY_NS,
    MAX_HEADER_BYTES,
    MAX_ID_CHARS,
    MAX_ITEMS,
    MAX_POSITION_M,
    MAX_POSITION_STD_M,
    MAX_SPEED_MPS,
    MAX_TEXT_CHARS,
    MAX_TILE,
    MAX_TIME_NS,
    MAX_TOTAL,
    MAX_TRACK_ID,
)


@dataclass(frozen=True, slots=True)
class Array:
    """Declares a field's dtype and shape; None is a free dimension."""

    dtype: str
    shape: tuple[int | None, ...]

    def check(self, value: Any) -> npt.NDArray[Any]:  # noqa: ANN401 - pydantic hands over anything
        """Returns the value as a contiguous read-only array.

        Raises:
            ValueError: wrong dtype kind, wrong shape or a non-finite number.
        """
        array = np.ascontiguousarray(value, np.dtype(self.dtype))
        self.check_shape(array.shape)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{np.count_nonzero(~np.isfinite(array))} numbers are not finite")
        if array.flags.writeable:
            array = array.view()
            array.setflags(write=False)
        return array

    def check_shape(self, shape: tuple[int, ...]) -> None:
        """Raises ValueError unless the shape is one that was declared."""
        fits = len(shape) == len(self.shape) and all(
            want is None or want == got for want, got in zip(self.shape, shape, strict=True)
        )
        if not fits:
            raise ValueError(f"array has shape {shape}, declared {self.shape}")

    def size_bytes(self, shape: tuple[int, ...]) -> int:
        """Returns how many bytes an array of this shape takes, in exact integers."""
        count = np.dtype(self.dtype).itemsize
        for side in shape:
            count *= side
        return count

    def __get_pydantic_core_schema__(
        self, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)


PoseRows = Annotated[npt.NDArray[np.float64], Array("<f8", (None, 6))]
PoseRow = Annotated[npt.NDArray[np.float64], Array("<f8", (6,))]
SiteRows = Annotated[npt.NDArray[np.float64], Array("<f8", (None, 2))]
WeightRows = Annotated[npt.NDArray[np.float64], Array("<f8", (None, 3))]
BoxRows = Annotated[npt.NDArray[np.float32], Array("<f4", (None, 7))]
Floats32 = Annotated[npt.NDArray[np.float32], Array("<f4", (None,))]
Bytes = Annotated[npt.NDArray[np.uint8], Array("|u1", (None,))]
Indices = Annotated[npt.NDArray[np.int32], Array("<i4", (None,))]
Integers = Annotated[npt.NDArray[np.int64], Array("<i8", (None,))]
Frames = Annotated[npt.NDArray[np.int64], Array("<i8", (None,))]
Cells = Annotated[npt.NDArray[np.int32], Array("<i4", (None, 2))]
Vertices = Annotated[npt.NDArray[np.float32], Array("<f4", (None, 3))]
Triangles = Annotated[npt.NDArray[np.int32], Array("<i4", (None, 3))]


class Message(BaseModel):
    """Base of all messages. Unknown header fields are tolerated, so that a minor side may add."""

    model_config = ConfigDict(
        frozen=True, extra="ignore", arbitrary_types_allowed=True, allow_inf_nan=False
    )
    kind: ClassVar[int]
    max_header_bytes: ClassVar[int] = MAX_HEADER_BYTES


class Part(BaseModel):
    """Base of the records that messages hold in lists."""

    model_config = ConfigDict(allow_inf_nan=False)


def check_lengths(message: Message, *columns: str) -> None:
    """Raises ValueError unless these columns of the message are equally long."""
    lengths = {name: len(getattr(message, name)) for name in columns}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"lists have lengths {lengths}, need one")


_POSE_LIMITS = np.array([MAX_POSITION_M] * 3 + [MAX_ANGLE_RAD] * 3)


def _known_classes(classes: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    if (classes > max(ObjectClass)).any():
        raise ValueError(f"class {classes.max()} is none of {[*map(int, ObjectClass)]}")
    return classes


def _within_reach(poses: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if not (np.abs(poses) <= _POSE_LIMITS).all():
        raise ValueError("a pose lies beyond 1e7 m or 1e3 rad")
    return poses


def _on_the_map(sites: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if not (np.abs(sites) <= MAX_POSITION_M).all():
        raise ValueError("a site lies beyond 1e7 m")
    return sites


def _known_tracks(ids: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    if not ((ids >= 0) & (ids < MAX_TRACK_ID)).all():
        raise ValueError("a track's id is not within 0 to 2^62")
    return ids


def _speeds(speeds_mps: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    if not (np.abs(speeds_mps) <= MAX_SPEED_MPS).all():
        raise ValueError(f"a speed lies beyond {MAX_SPEED_MPS:g} m/s")
    return speeds_mps


def _ages(ages_s: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    if not ((ages_s >= 0) & (ages_s <= MAX_COASTED_S)).all():
        raise ValueError(f"an age is not within 0 to {MAX_COASTED_S:g} s")
    return ages_s


def _deviations(std_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    if not ((std_m >= 0) & (std_m <= MAX_POSITION_STD_M)).all():
        raise ValueError(f"a standard deviation is not within 0 to {MAX_POSITION_STD_M:g}")
    return std_m


def _moderate(weights_m2: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if not (np.abs(weights_m2) <= MAX_POSITION_M**2).all():
        raise ValueError("a weight lies beyond 1e14 m^2")
    return weights_m2


def _short(agent: str) -> str:
    if len(agent) * 4 > MAX_AGENT_ID_BYTES and len(agent.encode()) > MAX_AGENT_ID_BYTES:
        raise ValueError(f"an agent's id takes more than {MAX_AGENT_ID_BYTES} bytes")
    return agent


def _plausible(boxes: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    if len(boxes) > MAX_ITEMS:
        raise ValueError(f"{len(boxes)} boxes, limit {MAX_ITEMS}")
    if not (np.abs(boxes) <= MAX_POSITION_M).all():
        raise ValueError("a number of a box lies beyond 1e7")
    return boxes


# Whoever shows a text may show it on a terminal, which obeys control characters. A pattern costs
# least: pydantic looks for it without calling Python.
_SEEN = r"^[^\x00-\x1f\x7f-\x9f]*$"
Id = Annotated[str, Field(min_length=1, max_length=MAX_ID_CHARS, pattern=_SEEN)]
AgentId = Annotated[Id, AfterValidator(_short)]  # many of them must fit into one message
NetId = Annotated[
    str,
    Field(min_length=1, max_length=MAX_TEXT_CHARS, pattern=_SEEN),
]
Text = Annotated[str, Field(max_length=MAX_TEXT_CHARS, pattern=_SEEN)]
Lights = Annotated[
    str, Field(max_length=MAX_TEXT_CHARS, pattern="^[GgyYrRsuoO]*$")
]  # a letter a link
FrameNumber = Annotated[int, Field(ge=0, lt=MAX_COUNT)]
Count = Annotated[int, Field(ge=0, lt=MAX_COUNT)]
Total = Annotated[int, Field(ge=0, lt=MAX_TOTAL)]
TimeNs = Annotated[int, Field(gt=-MAX_TIME_NS, lt=MAX_TIME_NS)]
Sites = Annotated[SiteRows, AfterValidator(_on_the_map)]
Weights = Annotated[WeightRows, AfterValidator(_moderate)]
Boxes = Annotated[BoxRows, AfterValidator(_plausible)]
ObjectClasses = Annotated[Bytes, AfterValidator(_known_classes)]
TrackIds = Annotated[Integers, AfterValidator(_known_tracks)]  # 0 is no track
Speeds = Annotated[Floats32, AfterValidator(_speeds)]
Ages = Annotated[Floats32, AfterValidator(_ages)]
Deviations = Annotated[Floats32, AfterValidator(_deviations)]
Pose = Annotated[PoseRow, AfterValidator(_within_reach)]
Poses = Annotated[PoseRows, AfterValidator(_within_reach)]
BOUNDED = (FailFast(), Field(max_length=MAX_ITEMS))  # one error will do, a million cost memory
Ids = Annotated[list[Id], *BOUNDED]
Texts = Annotated[list[Text], *BOUNDED]
_BODIES = (FailFast(), Field(max_length=MAX_BODIES))
BodyIds = Annotated[list[Id], *_BODIES]
BodyTexts = Annotated[list[Text], *_BODIES]
TileNumber = Annotated[int, Field(ge=-MAX_TILE, le=MAX_TILE)]
NEVER_NS = MAX_TIME_NS - 1  # the arrival of what a virtual link was not given any more
DelayNs = Annotated[int, Field(ge=0, le=MAX_DELAY_NS)]


class ObjectClass(IntEnum):
    """Classes of detected objects: lorries and buses are trucks, two-wheelers have a motor or none.

    Pedestrians are no vehicles: they are not counted in lanes.
    """

    CAR = 0
    TRUCK = 1
    TWO_WHEELER = 2
    PEDESTRIAN = 3


class Material(IntEnum):
    """What a surface is made of, for how much of a laser's light comes back."""

    PAINT = 0
    GLASS = 1
    RUBBER = 2
    METAL = 3
    RETROREFLECTOR = 4
    CLOTH = 5


class Equipment(IntEnum):
    """What a vehicle carries: nothing, a LiDAR and a radio, or a radio alone."""

    NONE = 0
    CAV = 1
    CV = 2
