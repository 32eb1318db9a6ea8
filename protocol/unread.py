"""Frames as an onlooker hears of them, kept as they came: who draws one in three reads no other."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from protocol.errors import ProtocolError
from protocol.inbox import Envelope
from protocol.messages import Message

MAX_OPEN_FRAMES = 8
MAX_FRAME_BYTES = 64 << 20
MAX_FRAME_MESSAGES = 1000


@dataclass(slots=True, eq=False)
class UnreadFrame:
    """What was heard of a frame so far."""

    number: int
    heard: list[Envelope] = field(default_factory=list)
    size_bytes: int = 0

    def add(self, item: Envelope, *, always: bool) -> None:
        """Adds a message, always or if there is room for it."""
        size_bytes = self.size_bytes + len(item.data)
        is_room = size_bytes <= MAX_FRAME_BYTES and len(self.heard) < MAX_FRAME_MESSAGES
        if always or is_room:
            self.size_bytes = size_bytes
            self.heard.append(item)

    def messages(self) -> Iterator[Message]:
        """Reads what was said, in the order in which it came; what cannot be read is left out."""
        for item in self.heard:
            if (message := _said_of(self.number, item)) is not None:
                yield message


class Unread:
    """The frames in the making.

    A frame is whole once the next one was brought to an end: by then all that travels slower has
    come, too. Only the newest whole ones wait, so that who is slow leaves frames out, whole ones,
    and never falls behind. No frame's number is trusted: what counts is the order of arrival.
    """

    def __init__(self, ending: str, waiting: int = 1) -> None:
        """Begins.

        Args:
            ending: a topic of which a message is said at the end of a frame, once in each.
            waiting: so many whole frames are kept.
        """
        self._ending = ending
        self._waiting = waiting
        self._open: dict[int, UnreadFrame] = {}
        self._ended: int | None = None
        self._whole: deque[UnreadFrame] = deque()
        self.left_out = 0

    def take(self, item: Envelope, number: int) -> None:
        """Adds a message to its frame."""
        ends = item.topic == self._ending
        if ends and _said_of(number, item) is None:
            return
        is_new_end = ends and number != self._ended
        self._frame(number).add(item, always=is_new_end)
        if is_new_end:
            self.finish()
            self._ended = number

    def finish(self) -> None:
        """Calls the frame that ended last whole."""
        ended, self._ended = self._ended, None
        if ended is None:
            return
        if (frame := self._open.pop(ended, None)) is not None:
            self._whole.append(frame)
        if frame is None or len(self._whole) > self._waiting:
            self.left_out += 1
        if len(self._whole) > self._waiting:
            self._whole.popleft()

    @property
    def is_due(self) -> bool:
        """Whether a whole frame waits."""
        return bool(self._whole)

    def next(self) -> UnreadFrame | None:
        """Returns the first whole frame that waits, once."""
        return self._whole.popleft() if self._whole else None

    def _frame(self, number: int) -> UnreadFrame:
        if number not in self._open:
            while len(self._open) >= MAX_OPEN_FRAMES:
                del self._open[next(iter(self._open))]  # the first that came: numbers may lie
            self._open[number] = UnreadFrame(number)
        return self._open[number]


def _said_of(number: int, item: Envelope) -> Message | None:
    """Returns what was said of a frame, None if it cannot be read or is of another frame."""
    try:
        message = item.message
    except ProtocolError:
        return None
    return message if getattr(message, "frame", None) == number else None
