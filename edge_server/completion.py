"""Frame completion: when a frame needs no more chunks, and which are late on virtual links.

A frame is complete when the space between any two neighbouring agents is covered. An agent whose
first chunk arrived covers its part up to the tight borders, with the second up to the plain and
with the third up to the wide ones; the fourth is all the rest that it sees. What one agent leaves
within its tight border, the other covers within its wide one: so two neighbours cover the space
between them once they have sent four chunks together. Neighbours are agents whose widest cells
meet. Then every place lies within the borders of an agent: its owner's, or, if the owner sent its
tight part only and the place lies beyond, those of the one that comes nearest to owning it, which
is a neighbour of the owner and has sent up to its wide border.

Unlike in EMP, every owner's first chunk is needed besides: within its tight border no other
sensor is as good, and a roadside unit on a wire, which sends all at once, would make the others'
scans useless.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from edge_server.frame import AgentDetections, Chunk, Frame
from protocol.messages import MAX_DELAY_NS, NEVER_NS, AgentPose

TOGETHER = 4  # chunks of two neighbours that cover the space between them


@dataclass(frozen=True, slots=True)
class UploadProgress:
    """How much of an agent's scan arrived: chunks without a gap from the first on, of how many.

    `chunks` is 0 while none arrived; `plan_frame` is then -1.
    """

    came: int
    chunks: int
    plan_frame: int

    @property
    def is_whole(self) -> bool:
        """Whether all chunks arrived."""
        return 0 < self.chunks == self.came

    def came_by(self, plan_frame: int) -> int:
        """Returns how many chunks of a plan arrived; a whole scan is as good as all of any plan."""
        if self.is_whole:
            return TOGETHER
        return self.came if self.plan_frame == plan_frame else 0


@dataclass(frozen=True, slots=True)
class CellBorders:
    """The agents of a plan, those with a cell that is not empty, and the pairs of neighbours."""

    agents: tuple[str, ...]
    owners: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]

    def covered(self, came: Mapping[str, int]) -> bool:
        """Whether these numbers of chunks cover the scene.

        An agent that is not among them has left, or its link is full; its part is covered when the
        next plan comes.
        """
        here = [(a, b) for a, b in self.pairs if a in came and b in came]
        own = [came[agent] for agent in self.owners if agent in came]
        return all(own) and all(came[a] + came[b] >= TOGETHER for a, b in here)


Part = AgentPose | AgentDetections | Chunk
IsEnough = Callable[[Mapping[str, UploadProgress]], bool]


@dataclass(frozen=True, slots=True)
class VirtualDeadline:
    """Deadline in simulated time: the edge waits `deadline_ns` from a frame's time on.

    Computing then takes `compute_ns`. Only simulated time decides which chunks are late.
    """

    deadline_ns: int
    compute_ns: int

    def cut(self, frame: Frame, covers: IsEnough | None = None) -> tuple[Frame, int]:
        """Returns the frame without late parts, with its delay, and the number of late parts.

        The delay is that of the last arrival that was needed, or the deadline if something was
        late. Parts without an arrival time came at once. With `covers`, chunks are needed only
        until it returns that they are enough.
        """
        latest_ns = frame.sim_time_ns + self.deadline_ns
        parts: list[Part] = [*frame.poses, *frame.found, *frame.chunks]
        needed_ns = max([frame.sim_time_ns, *(_arrival_ns(part) for part in parts)])
        if covers is not None:
            needed_ns = min(needed_ns, _enough_ns(frame, covers))
        in_time = needed_ns <= latest_ns
        end_ns = min(needed_ns, latest_ns)
        late = sum(end_ns < _arrival_ns(part) < NEVER_NS for part in parts)
        agents = {part.agent for part in parts if _arrival_ns(part) <= end_ns} & {*frame.agents}
        cut = replace(
            frame,
            agents=sorted(agents),
            poses=[pose for pose in frame.poses if _arrival_ns(pose) <= end_ns],
            found=[boxes for boxes in frame.found if _arrival_ns(boxes) <= end_ns],
            chunks=[chunk for chunk in frame.chunks if _arrival_ns(chunk) <= end_ns],
            complete=frame.complete and in_time,
            delay_sim_ns=min(end_ns - frame.sim_time_ns + self.compute_ns, MAX_DELAY_NS),
        )
        return cut, 0 if in_time else late

    def end_ns(self, cut: Frame) -> int:
        """Returns when the edge stopped waiting for more of a frame that was cut."""
        return cut.sim_time_ns + (cut.delay_sim_ns or 0) - self.compute_ns


def _arrival_ns(part: Part) -> int:
    return part.arrival_sim_ns or 0


def _enough_ns(frame: Frame, covers: IsEnough) -> int:
    """Returns when all poses and enough chunks had come; `NEVER_NS` if that was never so."""
    others: list[Part] = [*frame.poses, *frame.found]
    least_ns = max((_arrival_ns(part) for part in others), default=frame.sim_time_ns)
    moments_ns = {max(least_ns, _arrival_ns(chunk)) for chunk in frame.chunks} | {least_ns}
    for moment_ns in sorted(moments_ns):
        if covers(uploaded(frame, moment_ns)):
            return moment_ns
    return NEVER_NS


def uploaded(frame: Frame, until_ns: int = NEVER_NS) -> dict[str, UploadProgress]:
    """Returns the upload progress of all announced scans at a time, by agent."""
    found = dict.fromkeys(frame.scanning, UploadProgress(0, 0, -1))
    found |= {boxes.agent: UploadProgress(1, 1, -1) for boxes in frame.found}
    for chunk in frame.chunks:  # in the order of chunks
        came = found.get(chunk.agent, UploadProgress(0, 0, -1)).came
        if chunk.index == came and _arrival_ns(chunk) <= until_ns:
            found[chunk.agent] = UploadProgress(came + 1, chunk.chunk_count, chunk.plan_frame)
    return found
