"""A recording frame by frame: its summary, an agent's messages in a frame, and its upload."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from protocol.errors import ConfigError
from protocol.inbox import Envelope
from protocol.instances import vehicle_number
from protocol.limits import MAX_FRAMES_AHEAD
from protocol.messages import (
    AgentPose,
    Equipment,
    Metrics,
    Objects,
    Roster,
    Scan,
    Sighting,
    SignalState,
    Span,
    Tick,
    Truth,
)
from protocol.sequence_window import SequenceWindow
from recording.mcap.reader import McapReader
from sensing.radio import AgentKind
from sensing.uplink import FrameUpload, Uplink

FRAME_TOPIC = "state"
"""The topic that defines which frames are real: one message a frame, from the world."""


class RecordedFrames:
    """Reads a recording forward, frame by frame, so that a long one takes no memory.

    Messages are in the order of their arrival: some of a frame may come after others of the
    `MAX_FRAMES_AHEAD` frames that follow it. Later ones are counted in `late`, those with an
    impossible frame number in `absurd`.
    """

    def __init__(self, heard: Iterable[Envelope]) -> None:
        self._heard = iter(heard)
        self._has_more = True
        self._waiting: dict[int, list[Envelope]] = {}
        self._horizon = SequenceWindow()
        self._taken = -1
        self.late = 0
        self.absurd = 0

    def first(self, *topics: str) -> int | None:
        """Returns the lowest frame near the recording's beginning that has one of these topics."""
        self._read_beyond(0)
        self._read_beyond(min(self._waiting, default=0))
        return min(
            (
                frame
                for frame, items in self._waiting.items()
                if any(item.topic in topics for item in items)
            ),
            default=None,
        )

    def take(self, frame: int) -> list[Envelope]:
        """Returns all messages of a frame, in order of arrival, and forgets earlier frames."""
        self._read_beyond(frame)
        for passed in [number for number in self._waiting if number < frame]:
            del self._waiting[passed]
        self._taken = max(self._taken, frame)
        return self._waiting.pop(frame, [])

    def _read_beyond(self, frame: int) -> None:
        while self._has_more and self._horizon.newest < frame + MAX_FRAMES_AHEAD:
            item = next(self._heard, None)
            if item is None:
                self._has_more = False
            else:
                self._sort(item)

    def _sort(self, item: Envelope) -> None:
        frame: int = getattr(item.message, "frame", -1)
        if item.topic == FRAME_TOPIC:
            self._horizon.follow(frame)
        if frame <= self._taken:
            self.late += 1
        elif not self._horizon.admits(frame):
            self.absurd += 1
        else:
            self._waiting.setdefault(frame, []).append(item)


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """Summary of a recording: consecutive frames, some may be missing; `vehicles` are processes."""

    frames: int
    vehicles: int
    has_truth: bool

    @classmethod
    def of(cls, recording: McapReader) -> RecordingSummary:
        """Reads a recording once.

        Raises:
            ConfigError: it has no frame, or cannot be read.
        """
        horizon = SequenceWindow()
        times: set[int] = set()
        vehicles, has_truth = 0, False
        for item in recording.messages(["tick", "truth", "roster", FRAME_TOPIC]):
            message = item.message
            if isinstance(message, SignalState):
                horizon.follow(message.frame)
            if isinstance(message, Tick | SignalState) and horizon.admits(message.frame):
                times.add(message.frame)
            has_truth |= isinstance(message, Truth)
            if isinstance(message, Roster):
                vehicles = max(vehicles, vehicle_number(item.parts.get("process", "")) + 1)
        if not times:
            raise ConfigError(
                f"{recording.path}: holds no frame, neither a tick nor a state of the signal"
            )
        return cls(max(times) - min(times) + 1, vehicles, has_truth)


AGENT_TOPICS = ("roster", "pose", "scan", "objects", "sighting", "metrics")

Payload = Scan | Objects


@dataclass(frozen=True, slots=True, eq=False)
class AgentFrame:
    """An agent's messages of a frame: pose, if it drives; chunks without a gap, or boxes; sighting.

    `regions` are those that it sent them to, `parts` go to one of them each, in the order in which
    they were made. `spans` are its own stages, as its process measured them.
    """

    pose: AgentPose | None = None
    regions: tuple[str, ...] = ()
    parts: list[tuple[str, Payload]] = field(default_factory=list)
    sighting: Sighting | None = None
    spans: list[Span] = field(default_factory=list)

    @property
    def has_sensor(self) -> bool:
        """Whether the agent has a connection of its own: all but those that report their pose."""
        return self.pose is None or self.pose.equipment is Equipment.CAV

    @property
    def sense_start_ns(self) -> int | None:
        """When the agent began to scan, by its process's clock."""
        return min((part.sense_start_ns for _, part in self.parts), default=None)


def agent_frames(process: str, kind: AgentKind, items: Iterable[Envelope]) -> dict[str, AgentFrame]:
    """Returns by agent the messages of a process, in the order of its roster.

    A vehicle whose pose is not in the recording is left out: the edge would wait for it.
    """
    process_frame = _ProcessFrame(process)
    for item in items:
        process_frame.take(item)
    recorded = {agent: process_frame.recorded(agent) for agent in process_frame.agents}
    return {
        a: published
        for a, published in recorded.items()
        if kind == "roadside" or published.pose is not None
    }


def made_ns(part: Payload) -> int:
    """Returns when it was ready to be sent."""
    return part.encode_end_ns if isinstance(part, Scan) else part.detect_end_ns


class _ProcessFrame:
    def __init__(self, process: str) -> None:
        self._process = process
        self._rosters: list[Roster] = []
        self._poses: dict[str, AgentPose] = {}
        self._regions: dict[str, dict[str, None]] = {}
        self._chunks: dict[tuple[str, str], dict[int, Scan]] = {}
        self._objects: dict[tuple[str, str], Objects] = {}
        self._sightings: dict[str, Sighting] = {}
        self._spans: list[Span] = []

    def take(self, item: Envelope) -> None:
        """Adds a message of the process; of two of a kind, the first counts."""
        message = item.message
        if isinstance(message, Sighting):
            self._sightings.setdefault(message.agent, message)
            return
        if item.parts.get("process") != self._process:
            return
        region = item.parts.get("region", "")
        if isinstance(message, Roster):
            self._rosters.append(message)
            for agent in message.agents:
                self._regions.setdefault(agent, {})[region] = None
        elif isinstance(message, AgentPose | Scan | Objects):
            self._regions.setdefault(message.agent, {})[region] = None
        if isinstance(message, AgentPose):
            self._poses.setdefault(message.agent, message)
        elif isinstance(message, Scan):
            chunks = self._chunks.setdefault((message.agent, region), {})
            chunks.setdefault(message.chunk, message)
        elif isinstance(message, Objects):
            self._objects.setdefault((message.agent, region), message)
        elif isinstance(message, Metrics):
            self._spans += message.spans

    @property
    def agents(self) -> list[str]:
        named = [agent for roster in self._rosters for agent in roster.agents]
        return list(dict.fromkeys([*named, *sorted(self._regions)]))

    def recorded(self, agent: str) -> AgentFrame:
        parts: list[tuple[str, Payload]] = []
        for region in self._regions.get(agent, ()):
            objects = self._objects.get((agent, region))
            scans = _without_gap(self._chunks.get((agent, region), {}))
            parts += [(region, p) for p in ([*scans] if objects is None else [objects])]
        parts.sort(key=lambda part: made_ns(part[1]))
        spans = [span for span in self._spans if span.agent == agent]
        regions = tuple(self._regions.get(agent, ()))
        return AgentFrame(self._poses.get(agent), regions, parts, self._sightings.get(agent), spans)


def _without_gap(chunks: Mapping[int, Scan]) -> list[Scan]:
    """Returns the chunks from the first up to a gap, as if there were no others to wait for."""
    came = next(n for n in range(len(chunks) + 1) if n not in chunks)
    return [
        chunks[n] if chunks[n].chunks == came else chunks[n].model_copy(update={"chunks": came})
        for n in range(came)
    ]


@dataclass(frozen=True, slots=True)
class Pace:
    """Pacing in realtime: recorded messages are due as long after the frame's begin as then."""

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
    """Upload of recorded chunks or boxes, byte for byte.

    Their times are moved so that each was made as it is sent: the durations of its agent's work
    stay.
    """

    way: Uplink
    recorded: AgentFrame
    pace: Pace | None

    @property
    def chunks(self) -> int:
        """See `FrameUpload.chunks`."""
        return len(self.recorded.parts)

    def send(self, chunk: int) -> int:
        """See `FrameUpload.send`."""
        region, part = self.recorded.parts[chunk]
        if self.pace is not None:
            self.pace.wait(made_ns(part))
        shift_ns = time.monotonic_ns() - made_ns(part)
        if chunk == 0:
            self.spans += [
                self.way.span(span.stage, span.start_ns + shift_ns, span.end_ns + shift_ns)
                for span in _before_encoding(self.recorded)
            ]
        begun_ns = self._begun_ns(chunk) + shift_ns
        return self.way.send(self, _moved(part, shift_ns), region, begun_ns)

    def _begun_ns(self, chunk: int) -> int:
        """Returns when its making began: if unknown, right after the one before."""
        _, part = self.recorded.parts[chunk]
        own = [s for s in self.recorded.spans if s.stage == "encode" and s.end_ns == made_ns(part)]
        before_ns = part.sense_end_ns if chunk == 0 else made_ns(self.recorded.parts[chunk - 1][1])
        return own[0].start_ns if own else before_ns


def _before_encoding(recorded: AgentFrame) -> list[Span]:
    _, first = recorded.parts[0]
    sensed = Span(stage="sense", start_ns=first.sense_start_ns, end_ns=first.sense_end_ns)
    return [sensed, *(span for span in recorded.spans if span.stage == "select")]


def _moved(part: Payload, shift_ns: int) -> Payload:
    names = ["sense_start_ns", "sense_end_ns"]
    names.append("encode_end_ns" if isinstance(part, Scan) else "detect_end_ns")
    moved = {name: getattr(part, name) + shift_ns for name in names}
    return part.model_copy(update={**moved, "arrival_sim_ns": None})
