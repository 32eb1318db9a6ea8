"""What of a frame has arrived in time, where links are virtual: simulated time decides alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

from edge_server.frame import Frame, Piece
from protocol.messages import MAX_DELAY_NS, AgentPose


@dataclass(frozen=True, slots=True)
class Punctuality:
    """The edge waits `deadline_ns` from a frame's time on; computing then takes `compute_ns`."""

    deadline_ns: int
    compute_ns: int

    def cut(self, frame: Frame) -> tuple[Frame, int]:
        """Returns the frame without what arrived too late, with its delay, and how much that was.

        The delay is that of the last arrival, or the deadline if something was late. What names
        no arrival time came at once.
        """
        latest_ns = frame.sim_time_ns + self.deadline_ns
        poses = [p for p in frame.poses if (p.arrival_sim_ns or 0) <= latest_ns]
        pieces = [p for p in frame.pieces if (p.arrival_sim_ns or 0) <= latest_ns]
        late = len(frame.poses) - len(poses) + len(frame.pieces) - len(pieces)
        used: list[AgentPose | Piece] = [*poses, *pieces]
        arrivals_ns = [part.arrival_sim_ns or 0 for part in used]
        last_ns = latest_ns if late else max([frame.sim_time_ns, *arrivals_ns])
        cut = replace(
            frame,
            agents=sorted({part.agent for part in used}),
            poses=poses,
            pieces=pieces,
            complete=frame.complete and not late,
            delay_sim_ns=min(last_ns - frame.sim_time_ns + self.compute_ns, MAX_DELAY_NS),
        )
        return cut, late
