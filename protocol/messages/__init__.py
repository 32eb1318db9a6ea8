"""Every message, as a frozen record: scalars go into the header, arrays into the body.

Times ending in `_ns` without `sim_` come from `time.monotonic_ns` of the process that wrote them.
Poses are x, y, z in m and roll, pitch, yaw in rad, in the map frame.

Every number, text and list has a bound, so that one absurd message cannot spoil stored results.
Where links are virtual, `arrival_sim_ns` is when, in simulated time, the edge receives a message,
and `delay_sim_ns` how long after the frame's time a result arrives; else they are None. A message
that arrives at `NEVER_NS` was recalled from the link before it left.
"""

from protocol.limits import MAX_DELAY_NS, MAX_ITEMS
from protocol.messages.fields import NEVER_NS, Equipment, Material, Message, ObjectClass, Part
from protocol.messages.metrics import (
    AgentAlignment,
    AgentScore,
    Arrival,
    JunctionProgress,
    Metrics,
    Progress,
    RegionProgress,
    Span,
    Upload,
    WireCount,
)
from protocol.messages.v2x import (
    AgentPose,
    BorderObjects,
    Detections,
    LaneCounts,
    Objects,
    Plan,
    Roster,
    Scan,
    SignalRequest,
    SignalState,
    SpeedAdvice,
)
from protocol.messages.world import (
    PARKED,
    PEDESTRIAN,
    ClockReading,
    End,
    MeshPart,
    Setup,
    Sighting,
    Tick,
    TileBodies,
    TileRequest,
    TimeReply,
    Trip,
    Trips,
    Truth,
    VehicleType,
    is_bystander,
)

__all__ = [
    "MAX_DELAY_NS",
    "MAX_ITEMS",
    "MESSAGES",
    "NEVER_NS",
    "PARKED",
    "PEDESTRIAN",
    "AgentAlignment",
    "AgentPose",
    "AgentScore",
    "Arrival",
    "BorderObjects",
    "ClockReading",
    "Detections",
    "End",
    "Equipment",
    "JunctionProgress",
    "LaneCounts",
    "Material",
    "MeshPart",
    "Message",
    "Metrics",
    "ObjectClass",
    "Objects",
    "Part",
    "Plan",
    "Progress",
    "RegionProgress",
    "Roster",
    "Scan",
    "Setup",
    "Sighting",
    "SignalRequest",
    "SignalState",
    "Span",
    "SpeedAdvice",
    "Tick",
    "TileBodies",
    "TileRequest",
    "TimeReply",
    "Trip",
    "Trips",
    "Truth",
    "Upload",
    "VehicleType",
    "WireCount",
    "is_bystander",
]

MESSAGES: dict[int, type[Message]] = {
    m.kind: m for m in sorted(Message.__subclasses__(), key=lambda m: m.kind)
}
