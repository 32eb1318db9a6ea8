"""A frame as an onlooker heard of it, put together from many messages."""

from __future__ import annotations

from dataclasses import dataclass, field

from protocol.messages import (
    Detections,
    LaneCounts,
    Message,
    Plan,
    Scan,
    SignalRequest,
    SignalState,
    Truth,
)
from protocol.unread import UnreadFrame


@dataclass(slots=True, eq=False)
class Moment:
    """What was said of one frame, as far as it came and could be read."""

    frame: int
    scans: list[Scan] = field(default_factory=list)
    detections: Detections | None = None
    truth: Truth | None = None
    counts: LaneCounts | None = None
    state: SignalState | None = None
    request: SignalRequest | None = None
    plan: Plan | None = None

    @property
    def sim_time_ns(self) -> int | None:
        """The world's time at the frame, None as long as nobody said it."""
        told = (self.counts, self.detections, self.truth, self.state, self.request)
        return next((message.sim_time_ns for message in told if message is not None), None)

    @classmethod
    def of(cls, frame: UnreadFrame) -> Moment:
        """Reads what was heard of a frame."""
        moment = cls(frame.number)
        for message in frame.messages():
            moment._add(message)
        return moment

    def _add(self, message: Message) -> None:
        match message:
            case Scan():
                self.scans.append(message)
            case Detections():
                self.detections = message
            case Truth():
                self.truth = message
            case LaneCounts():
                self.counts = message
            case SignalState():
                self.state = message
            case SignalRequest():
                self.request = message
            case Plan():
                self.plan = message
