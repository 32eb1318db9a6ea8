"""The last few frames, put together from what many processes say of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from protocol.errors import MessageError
from protocol.messages import Arrival, Metrics, Span, Upload
from recorder.tables import FrameRow, UploadRow

OPEN_FRAMES = 256
"""So many frames before the newest tick are still changed; what is older is settled."""

_LONGEST_NS = 60_000_000_000
_NOBODY: tuple[None, ...] = (None,) * 8


@dataclass(slots=True)
class FrameNote:
    """What is known of one frame so far."""

    frame: int
    sim_time_ns: int | None = None
    vehicles: int | None = None
    cavs: int | None = None
    cvs: int | None = None
    agents: int | None = None
    points: int | None = None
    detections: int | None = None
    complete: bool | None = None
    tick_ns: int | None = None
    request_ns: int | None = None
    actuate: Span | None = None
    uploads: dict[tuple[str, int], Upload] = field(default_factory=dict)
    arrivals: dict[tuple[str, int], Arrival] = field(default_factory=dict)
    heard: set[str] = field(default_factory=set)

    def measured(self, metrics: Metrics) -> None:
        """Adds what one process measured in this frame."""
        self.heard.add(metrics.process)
        self.uploads |= {(upload.agent, upload.chunk): upload for upload in metrics.uploads}
        self.arrivals |= {(arrival.agent, arrival.chunk): arrival for arrival in metrics.arrivals}
        if metrics.process == "edge":
            self.points = metrics.points
        if metrics.process == "sim":
            acts = [span for span in metrics.spans if span.stage == "actuate"]
            self.actuate = acts[-1] if acts else self.actuate

    @property
    def end_to_end_ns(self) -> int | None:
        """From the first sensing (without any, the tick) until the signal cabinet has acted.

        None if the request came before the frame was sensed, for it then answers an earlier one,
        or if a minute lies between, for the clocks are then those of different machines.
        """
        senses = [upload.sense_start_ns for upload in self.uploads.values()]
        start_ns = min(senses, default=self.tick_ns)
        if start_ns is None or self.actuate is None or self.actuate.start_ns < start_ns:
            return None
        took_ns = self.actuate.end_ns - start_ns
        return took_ns if took_ns <= _LONGEST_NS else None

    def row(self) -> FrameRow:
        """Returns the frame as a row."""
        return FrameRow(
            self.frame,
            self.sim_time_ns,
            self.vehicles,
            self.cavs,
            self.cvs,
            self.agents,
            self.points,
            self.detections,
            None if self.complete is None else int(self.complete),
            self.tick_ns,
            self.request_ns,
            self.end_to_end_ns,
        )

    def upload_rows(self) -> Iterator[UploadRow]:
        """Returns a row per chunk that its sender or the edge spoke of."""
        for key in sorted(self.uploads.keys() | self.arrivals.keys()):
            sent, came = self.uploads.get(key), self.arrivals.get(key)
            sender = _NOBODY if sent is None else _as_sent(sent)
            edge = (None, None) if came is None else (came.received_ns, came.decoded_ns)
            yield UploadRow(self.frame, *key, *sender, *edge)


class Ledger:
    """Notes of the newest frames; a frame is written again whenever more was heard of it."""

    def __init__(self) -> None:
        self._notes: dict[int, FrameNote] = {}
        self._changed: set[int] = set()
        self.newest_tick = -1

    def __len__(self) -> int:
        return len(self._notes)

    def tick(self, frame: int) -> FrameNote:
        """Returns the note of a frame that the world has begun."""
        self.newest_tick = max(self.newest_tick, frame)
        return self.note(frame)

    def note(self, frame: int) -> FrameNote:
        """Returns the note of a frame, to be changed by the caller.

        Raises:
            MessageError: the frame is settled, or far ahead of the world.
        """
        self.check(frame)
        self._changed.add(frame)
        return self._notes.setdefault(frame, FrameNote(frame))

    def check(self, frame: int) -> None:
        """Raises MessageError if a frame is settled, or far ahead of the world."""
        if abs(frame - self.newest_tick) > OPEN_FRAMES:
            raise MessageError(f"frame {frame} is too far from the world's {self.newest_tick}")

    def get(self, frame: int) -> FrameNote | None:
        """Returns the note of a frame to look at, if it is open."""
        return self._notes.get(frame)

    def take_changed(self) -> list[FrameNote]:
        """Returns the notes that changed since the last call, and forgets the settled ones."""
        changed = [self._notes[frame] for frame in sorted(self._changed)]
        self._changed.clear()
        oldest = self.newest_tick - OPEN_FRAMES
        for frame in [frame for frame in self._notes if frame < oldest]:
            del self._notes[frame]
        return changed


def _as_sent(upload: Upload) -> tuple[int | None, ...]:
    return (
        upload.points,
        upload.payload_bytes,
        upload.wire_bytes,
        upload.sense_start_ns,
        upload.sense_end_ns,
        upload.encode_end_ns,
        upload.sent_ns,
        upload.link_sim_ns,
    )
