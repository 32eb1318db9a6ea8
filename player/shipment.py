"""A recorded scan on its way once more."""

from __future__ import annotations

import time
from dataclasses import dataclass

from player.words import Part, Words, made_ns
from protocol.messages import Scan, Span
from sensing.uplink import FrameUpload, Uplink


@dataclass(frozen=True, slots=True)
class Pace:
    """When what was recorded is due in realtime: so long after the frame's begin as it was then."""

    recorded_ns: int
    begun_ns: int
    longest_ns: int
    speed: float

    def wait(self, recorded_ns: int) -> None:
        """Waits until it is due, for one frame at most."""
        after_ns = min(max(0, recorded_ns - self.recorded_ns), self.longest_ns)
        left_ns = self.begun_ns + round(after_ns / self.speed) - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns / 1e9)


@dataclass(slots=True, eq=False)
class Played(FrameUpload):
    """The same chunks or boxes, byte for byte.

    Their times are moved so that each was made as it is sent: what its agent's work took stays.
    """

    way: Uplink
    words: Words
    pace: Pace | None

    @property
    def chunks(self) -> int:
        """See `FrameUpload.chunks`."""
        return len(self.words.parts)

    def send(self, chunk: int) -> int:
        """See `FrameUpload.send`."""
        part = self.words.parts[chunk]
        if self.pace is not None:
            self.pace.wait(made_ns(part))
        shift_ns = time.monotonic_ns() - made_ns(part)
        if chunk == 0:
            self.spans += [
                self.way.span(span.stage, span.start_ns + shift_ns, span.end_ns + shift_ns)
                for span in _before_encoding(self.words)
            ]
        return self.way.send(self, _moved(part, shift_ns), self._begun_ns(chunk) + shift_ns)

    def _begun_ns(self, chunk: int) -> int:
        """Returns when it began to be made; as far as is known, right after what came before."""
        part = self.words.parts[chunk]
        own = [s for s in self.words.spans if s.stage == "encode" and s.end_ns == made_ns(part)]
        before_ns = part.sense_end_ns if chunk == 0 else made_ns(self.words.parts[chunk - 1])
        return own[0].start_ns if own else before_ns


def _before_encoding(words: Words) -> list[Span]:
    first = words.parts[0]
    sensed = Span(stage="sense", start_ns=first.sense_start_ns, end_ns=first.sense_end_ns)
    return [sensed, *(span for span in words.spans if span.stage == "select")]


def _moved(part: Part, shift_ns: int) -> Part:
    names = ["sense_start_ns", "sense_end_ns"]
    names.append("encode_end_ns" if isinstance(part, Scan) else "detect_end_ns")
    moved = {name: getattr(part, name) + shift_ns for name in names}
    return part.model_copy(update={**moved, "arrival_sim_ns": None})
