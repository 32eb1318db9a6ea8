"""What came of one frame so far, within bounds: who was announced comes before who was not."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TypeVar

from edge_server.coverage import Uploaded
from edge_server.frame import Found, Piece
from protocol.messages import AgentPose, Roster, Scan

K = TypeVar("K")
V = TypeVar("V")

MAX_AGENTS = 512  # of a frame
MAX_PIECES = 4 * MAX_AGENTS
MAX_BOXES = 4 * MAX_AGENTS  # that agents found for themselves
MAX_POINTS = 10_000_000  # of a frame; placed, they take 160 MB


@dataclass(slots=True, eq=False)
class Gathering:
    """A frame under way. Chunks are known by (agent, chunk); `drops` counts what came in vain.

    `opening` are the chunks that were wanted and are not decoded yet. Once it `is_closing`, no more
    are wanted.
    """

    first_ns: int
    drops: Counter[str]
    time_ns: int | None = None
    rosters: dict[str, Roster] = field(default_factory=dict)
    poses: dict[str, AgentPose] = field(default_factory=dict)
    pieces: dict[tuple[str, int], Piece] = field(default_factory=dict)
    chunk_counts: dict[str, int] = field(default_factory=dict)
    found: dict[str, Found] = field(default_factory=dict)
    opening: set[tuple[str, int]] = field(default_factory=set)
    is_closing: bool = False

    def add_roster(self, roster: Roster) -> None:
        """Takes a process's first roster."""
        held = sum(_size(other) + 1 for other in self.rosters.values())
        if roster.process in self.rosters:
            self.drops["duplicate"] += 1
        elif held + _size(roster) > MAX_AGENTS:
            self.drops["too_many_agents"] += 1
        else:
            self.rosters[roster.process] = roster

    def add_pose(self, pose: AgentPose) -> None:
        """Takes an agent's first pose."""
        if pose.agent in self.poses:
            self.drops["duplicate"] += 1
            return
        if len(self.poses) >= MAX_AGENTS and self._is_announced(pose.agent):
            self._oust(self.poses, [agent for agent in self.poses if not self._is_announced(agent)])
        if len(self.poses) >= MAX_AGENTS:
            self.drops["too_many_agents"] += 1
            return
        self.poses[pose.agent] = pose
        self._date(pose.sim_time_ns)

    def add_found(self, found: Found) -> None:
        """Takes the first boxes that an agent found for itself."""
        if found.agent in self.found:
            self.drops["duplicate"] += 1
        elif len(self.found) >= MAX_AGENTS:
            self.drops["too_many_agents"] += 1
        elif sum(len(one.objects.boxes) for one in [*self.found.values(), found]) > MAX_BOXES:
            self.drops["frame_too_large"] += 1
        else:
            self.found[found.agent] = found
            self._date(found.objects.sim_time_ns)

    def wants(self, scan: Scan) -> bool:
        """Whether a chunk is new, agrees with its fellows and has room; counts it if not."""
        key = scan.agent, scan.chunk
        if key in self.pieces or key in self.opening:
            reason = "duplicate"
        elif self.is_closing:
            reason = "late"
        elif self.chunk_counts.get(scan.agent, scan.chunks) != scan.chunks:
            reason = "contradiction"
        elif len(self.pieces) >= MAX_PIECES and not self._can_oust_for(scan.agent):
            reason = "too_many_agents"
        else:
            return True
        self.drops[reason] += 1
        return False

    def begin(self, scan: Scan) -> None:
        """Takes note that a chunk that was wanted is being decoded."""
        self.opening.add((scan.agent, scan.chunk))
        self.chunk_counts[scan.agent] = scan.chunks

    def forgo(self, scan: Scan) -> None:
        """Takes note that a chunk will not come after all."""
        self.opening.discard((scan.agent, scan.chunk))

    def add_piece(self, piece: Piece) -> None:
        """Takes a decoded chunk that was wanted."""
        self.opening.discard((piece.agent, piece.index))
        while not self._fits(piece) and self._can_oust_for(piece.agent):
            self._oust(self.pieces, [key for key in self.pieces if not self._is_announced(key[0])])
        if not self._fits(piece):
            self.drops["frame_too_large"] += 1
            return
        self.chunk_counts[piece.agent] = piece.chunk_count
        self.pieces[piece.agent, piece.index] = piece
        self._date(piece.sim_time_ns)

    def has_poses(self, roster: Roster) -> bool:
        """Whether all poses came that a roster announces."""
        return all(agent in self.poses for agent in roster.agents)

    def uploaded(self, agent: str) -> Uploaded:
        """Returns how far an agent's scan came; boxes of its own count as a whole scan."""
        if agent in self.found:
            return Uploaded(1, 1, -1)
        chunks, came = self.chunk_counts.get(agent, 0), 0
        while came < chunks and (agent, came) in self.pieces:
            came += 1
        return Uploaded(came, chunks, self.pieces[agent, 0].plan_frame if came else -1)

    def named(self) -> list[str]:
        """Returns of whom something came, sorted; of too many those who were announced first."""
        came = {*self.poses, *self.found, *(agent for agent, _ in self.pieces)}
        if len(came) > MAX_AGENTS:
            came = set(sorted(came, key=lambda a: (not self._is_announced(a), a))[:MAX_AGENTS])
        return sorted(came)

    def _is_announced(self, agent: str) -> bool:
        return any(agent in roster.agents for roster in self.rosters.values())

    def _can_oust_for(self, agent: str) -> bool:
        return self._is_announced(agent) and not all(self._is_announced(a) for a, _ in self.pieces)

    def _fits(self, piece: Piece) -> bool:
        returns = piece.returns + sum(other.returns for other in self.pieces.values())
        return len(self.pieces) < MAX_PIECES and returns <= MAX_POINTS

    def _oust(self, held: dict[K, V], strangers: list[K]) -> None:
        if strangers:
            del held[strangers[-1]]
            self.drops["stranger_ousted"] += 1

    def _date(self, sim_time_ns: int) -> None:
        if self.time_ns is None:
            self.time_ns = sim_time_ns


def _size(roster: Roster) -> int:
    """Returns how many agents a roster names, be they rightly in both of its lists or not."""
    return max(len(roster.agents), len(roster.scanning))
