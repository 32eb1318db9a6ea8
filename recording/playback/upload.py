"""The recorded messages of an agent in a frame, and their upload in a replay."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from protocol.inbox import Envelope
from protocol.messages import AgentPose, Equipment, Metrics, Objects, Roster, Scan, Sighting, Span
from sensing.radio import AgentKind
from sensing.uplink import FrameUpload, Uplink

AGENT_TOPICS = ("roster", "pose", "scan", "objects", "sighting", "metrics")

Payload = Scan | Objects


@dataclass(frozen=True, slots=True, eq=False)
class AgentFrame:
    """What an agent said: its pose, if it drives; chunks without a gap, or boxes; what it saw.

    `spans` are its own stages, as its process measured them.
    """

    pose: AgentPose | None = None
    parts: list[Payload] = field(default_factory=list)
    sighting: Sighting | None = None
    spans: list[Span] = field(default_factory=list)

    @property
    def has_sensor(self) -> bool:
        """Whether the agent has a connection of its own: all but those that report their pose."""
        return self.pose is None or self.pose.equipment is Equipment.CAV

    @property
    def sense_start_ns(self) -> int | None:
        """When it began, by its process's clock."""
        return min((part.sense_start_ns for part in self.parts), default=None)


def agent_frames(process: str, kind: AgentKind, items: Iterable[Envelope]) -> dict[str, AgentFrame]:
    """Returns by agent what a process published, in the order of its roster.

    A vehicle whose pose is not in the recording is left out: the edge would wait for it.
    """
    told = _ProcessFrame(process)
    for item in items:
        told.take(item)
    words = {agent: told.words(agent) for agent in told.agents}
    return {a: said for a, said in words.items() if kind == "roadside" or said.pose is not None}


def made_ns(part: Payload) -> int:
    """Returns when it was ready to be sent."""
    return part.encode_end_ns if isinstance(part, Scan) else part.detect_end_ns


class _ProcessFrame:
    def __init__(self, process: str) -> None:
        self._process = process
        self._rosters: list[Roster] = []
        self._poses: dict[str, AgentPose] = {}
        self._chunks: dict[str, dict[int, Scan]] = {}
        self._objects: dict[str, Objects] = {}
        self._sightings: dict[str, Sighting] = {}
        self._spans: list[Span] = []

    def take(self, item: Envelope) -> None:
        """Takes what is the process's own; of two of a kind, the first."""
        message = item.message
        if isinstance(message, Sighting):
            self._sightings.setdefault(message.agent, message)
        elif item.parts.get("process") != self._process:
            return
        elif isinstance(message, Roster):
            self._rosters.append(message)
        elif isinstance(message, AgentPose):
            self._poses.setdefault(message.agent, message)
        elif isinstance(message, Scan):
            self._chunks.setdefault(message.agent, {}).setdefault(message.chunk, message)
        elif isinstance(message, Objects):
            self._objects.setdefault(message.agent, message)
        elif isinstance(message, Metrics):
            self._spans += message.spans

    @property
    def agents(self) -> list[str]:
        named = self._rosters[0].agents if self._rosters else []
        heard = sorted(self._poses.keys() | self._chunks.keys() | self._objects.keys())
        return list(dict.fromkeys([*named, *heard]))

    def words(self, agent: str) -> AgentFrame:
        objects = self._objects.get(agent)
        scans = _without_gap(self._chunks.get(agent, {}))
        parts: list[Payload] = [objects] if objects is not None else [*scans]
        spans = [span for span in self._spans if span.agent == agent]
        return AgentFrame(self._poses.get(agent), parts, self._sightings.get(agent), spans)


def _without_gap(chunks: Mapping[int, Scan]) -> list[Scan]:
    """Returns the chunks from the first on, as if there were no others: none is waited for."""
    came = next(n for n in range(len(chunks) + 1) if n not in chunks)
    return [
        chunks[n] if chunks[n].chunks == came else chunks[n].model_copy(update={"chunks": came})
        for n in range(came)
    ]


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
class ReplayedUpload(FrameUpload):
    """The same chunks or boxes, byte for byte.

    Their times are moved so that each was made as it is sent: what its agent's work took stays.
    """

    way: Uplink
    words: AgentFrame
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


def _before_encoding(words: AgentFrame) -> list[Span]:
    first = words.parts[0]
    sensed = Span(stage="sense", start_ns=first.sense_start_ns, end_ns=first.sense_end_ns)
    return [sensed, *(span for span in words.spans if span.stage == "select")]


def _moved(part: Payload, shift_ns: int) -> Payload:
    names = ["sense_start_ns", "sense_end_ns"]
    names.append("encode_end_ns" if isinstance(part, Scan) else "detect_end_ns")
    moved = {name: getattr(part, name) + shift_ns for name in names}
    return part.model_copy(update={**moved, "arrival_sim_ns": None})
