"""What of a frame has arrived in time, where links are virtual: simulated time decides alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from edge_server.coverage import Uploaded
from edge_server.frame import Found, Frame, Piece
from protocol.messages import MAX_DELAY_NS, NEVER_NS, AgentPose

Part = AgentPose | Found | Piece
Covers = Callable[[Mapping[str, Uploaded]], bool]


@dataclass(frozen=True, slots=True)
class Punctuality:
    """The edge waits `deadline_ns` from a frame's time on; computing then takes `compute_ns`."""

    deadline_ns: int
    compute_ns: int

    def cut(self, frame: Frame, covers: Covers | None = None) -> tuple[Frame, int]:
        """Returns the frame without what arrived too late, with its delay, and how much that was.

        The delay is that of the last arrival that was needed, or the deadline if something was
        late. What names no arrival time came at once. With `covers`, chunks are needed only until
        it says that they are enough.
        """
        latest_ns = frame.sim_time_ns + self.deadline_ns
        parts: list[Part] = [*frame.poses, *frame.found, *frame.pieces]
        needed_ns = max([frame.sim_time_ns, *(_arrival_ns(part) for part in parts)])
        if covers is not None:
            needed_ns = min(needed_ns, _covered_ns(frame, covers))
        in_time = needed_ns <= latest_ns
        end_ns = min(needed_ns, latest_ns)
        late = sum(end_ns < _arrival_ns(part) < NEVER_NS for part in parts)
        agents = {part.agent for part in parts if _arrival_ns(part) <= end_ns} & {*frame.agents}
        cut = replace(
            frame,
            agents=sorted(agents),
            poses=[pose for pose in frame.poses if _arrival_ns(pose) <= end_ns],
            found=[boxes for boxes in frame.found if _arrival_ns(boxes) <= end_ns],
            pieces=[piece for piece in frame.pieces if _arrival_ns(piece) <= end_ns],
            complete=frame.complete and in_time,
            delay_sim_ns=min(end_ns - frame.sim_time_ns + self.compute_ns, MAX_DELAY_NS),
        )
        return cut, 0 if in_time else late

    def end_ns(self, cut: Frame) -> int:
        """Returns when the edge stopped waiting for more of a frame that was cut."""
        return cut.sim_time_ns + (cut.delay_sim_ns or 0) - self.compute_ns


def _arrival_ns(part: Part) -> int:
    return part.arrival_sim_ns or 0


def _covered_ns(frame: Frame, covers: Covers) -> int:
    """Returns when all poses and enough chunks had come; `NEVER_NS` if that was never so."""
    others: list[Part] = [*frame.poses, *frame.found]
    least_ns = max((_arrival_ns(part) for part in others), default=frame.sim_time_ns)
    moments_ns = {max(least_ns, _arrival_ns(piece)) for piece in frame.pieces} | {least_ns}
    for moment_ns in sorted(moments_ns):
        if covers(_uploaded(frame, moment_ns)):
            return moment_ns
    return NEVER_NS


def _uploaded(frame: Frame, until_ns: int) -> dict[str, Uploaded]:
    """Returns how far the scans of all who announced one had come then."""
    uploaded = dict.fromkeys(frame.scanning, Uploaded(0, 0, -1))
    uploaded |= {boxes.agent: Uploaded(1, 1, -1) for boxes in frame.found}
    for piece in frame.pieces:  # in the order of chunks
        came = uploaded.get(piece.agent, Uploaded(0, 0, -1)).came
        if piece.index == came and _arrival_ns(piece) <= until_ns:
            uploaded[piece.agent] = Uploaded(came + 1, piece.chunk_count, piece.plan_frame)
    return uploaded
