"""What one process said in a frame, agent by agent, as far as the tape has it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from protocol.inbox import Envelope
from protocol.messages import AgentPose, Equipment, Metrics, Objects, Roster, Scan, Sighting, Span
from sensing.radio import AgentKind

SAID = ("roster", "pose", "scan", "objects", "sighting", "metrics")

Part = Scan | Objects


@dataclass(frozen=True, slots=True, eq=False)
class Words:
    """What an agent said: its pose, if it drives; chunks without a gap, or boxes; what it saw.

    `spans` are its own stages, as its process measured them.
    """

    pose: AgentPose | None = None
    parts: list[Part] = field(default_factory=list)
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


def words_of(process: str, kind: AgentKind, items: Iterable[Envelope]) -> dict[str, Words]:
    """Returns by agent what a process said, in the order of its roster.

    An agent that drives and of which the tape has no pose is left out: the edge would wait for it.
    """
    told = _Told(process)
    for item in items:
        told.take(item)
    words = {agent: told.words(agent) for agent in told.agents}
    return {a: said for a, said in words.items() if kind == "roadside" or said.pose is not None}


def made_ns(part: Part) -> int:
    """Returns when it was ready to be sent."""
    return part.encode_end_ns if isinstance(part, Scan) else part.detect_end_ns


class _Told:
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

    def words(self, agent: str) -> Words:
        objects = self._objects.get(agent)
        scans = _without_gap(self._chunks.get(agent, {}))
        parts: list[Part] = [objects] if objects is not None else [*scans]
        spans = [span for span in self._spans if span.agent == agent]
        return Words(self._poses.get(agent), parts, self._sightings.get(agent), spans)


def _without_gap(chunks: Mapping[int, Scan]) -> list[Scan]:
    """Returns the chunks from the first on, as if there were no others: none is waited for."""
    came = next(n for n in range(len(chunks) + 1) if n not in chunks)
    return [
        chunks[n] if chunks[n].chunks == came else chunks[n].model_copy(update={"chunks": came})
        for n in range(came)
    ]
