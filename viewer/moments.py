"""Frames as an onlooker hears of them, put together from many messages."""

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

OPEN_MOMENTS = 16
MAX_SCANS = 512  # chunks of one frame


@dataclass(slots=True, eq=False)
class Moment:
    """What was said of one frame, as far as it came."""

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

    def take(self, message: Message) -> None:
        """Adds a message of this frame; of too many scans the rest is left out."""
        match message:
            case Scan():
                if len(self.scans) < MAX_SCANS:
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


TAKEN = (Scan, Detections, Truth, LaneCounts, SignalState, SignalRequest, Plan)


class Moments:
    """The frames in the making.

    A frame is whole once the next one was counted: by then all that travels slower has come, too.
    Only the newest whole one is given out, so that who is slow leaves frames out, whole ones, and
    never falls behind. No frame's number is trusted: what counts is the order of arrival.
    """

    def __init__(self) -> None:
        self._open: dict[int, Moment] = {}
        self._counted: Moment | None = None
        self._whole: Moment | None = None
        self.left_out = 0

    def take(self, message: Message) -> None:
        """Adds a message to its frame, if it is one that moments are made of."""
        if not isinstance(message, TAKEN):
            return
        moment = self._open.get(message.frame)
        if moment is None:
            moment = self._open[message.frame] = Moment(message.frame)
            while len(self._open) > OPEN_MOMENTS:
                del self._open[next(iter(self._open))]
        moment.take(message)
        if isinstance(message, LaneCounts) and moment is not self._counted:
            self._finish(self._counted)
            self._counted = moment

    def finish(self) -> None:
        """Calls the last frame whole: no other will follow it."""
        self._finish(self._counted)
        self._counted = None

    def newest(self) -> Moment | None:
        """Returns the newest frame that is whole, once."""
        whole, self._whole = self._whole, None
        return whole

    def _finish(self, moment: Moment | None) -> None:
        if moment is None:
            return
        self.left_out += self._whole is not None
        self._whole = moment
        self._open.pop(moment.frame, None)
