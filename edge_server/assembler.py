"""Puts together what belongs to one frame, and says when it is whole or when to stop waiting."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from edge_server.coverage import Uploaded
from edge_server.frame import Frame, Piece
from protocol.messages import AgentPose, Objects, Roster, Scan

MAX_OPEN_FRAMES = 4
MAX_AHEAD = 4  # frames before the world's; what claims to be newer is made up
MAX_AGENTS = 512  # of a frame
MAX_PIECES = 4 * MAX_AGENTS
MAX_BYTES = 128 << 20  # of decoded points of a frame
NO_POSE_ROLE = "infra"  # a post's place is in its scans


@dataclass(slots=True, eq=False)
class _OpenFrame:
    """A frame under way. Chunks are known by (agent, chunk)."""

    first_ns: int
    rosters: dict[str, Roster] = field(default_factory=dict)
    poses: dict[str, AgentPose] = field(default_factory=dict)
    pieces: dict[tuple[str, int], Piece] = field(default_factory=dict)
    objects: dict[str, Objects] = field(default_factory=dict)
    chunks: dict[str, int] = field(default_factory=dict)
    size_bytes: int = 0

    def uploaded(self, agent: str) -> Uploaded:
        """Returns how far an agent's scan came; objects count as a whole scan."""
        if agent in self.objects:
            return Uploaded(1, 1, -1)
        chunks, came = self.chunks.get(agent, 0), 0
        while came < chunks and (agent, came) in self.pieces:
            came += 1
        plan_frame = self.pieces[agent, 0].plan_frame if came else -1
        return Uploaded(came, chunks, plan_frame)


class Assembler:
    """Knows which processes live and waits for all that they announce, up to `wait_ns`.

    A process is waited for from the start if it was expected, else from its first roster on, until
    it vanishes. Of scans, less may be enough: `covers` decides by how far each came. `drops`
    counts, by reason, what came in vain.
    """

    def __init__(
        self,
        *,
        wait_ns: int,
        expected: dict[str, str],
        covers: Callable[[Mapping[str, Uploaded]], bool] | None = None,
    ) -> None:
        self._wait_ns = wait_ns
        self._covers = covers
        self._world: int | None = None
        self._roles = dict(expected)
        self._alive: set[str] = set()
        self._heard = set(expected)
        self._open: dict[int, _OpenFrame] = {}
        self._times_ns: dict[int, int] = {}
        self._finished = -1
        self._had_enough: deque[int] = deque(maxlen=MAX_OPEN_FRAMES)
        self.drops: Counter[str] = Counter()

    def hear(self, process: str, role: str, *, alive: bool) -> None:
        """Takes note of a process that appeared or vanished."""
        self._roles[process] = role
        if alive:
            self._alive.add(process)
        else:
            self._alive.discard(process)
            self._heard.discard(process)

    def hear_world(self, frame: int, sim_time_ns: int) -> None:
        """Takes note of the frame that the world is at."""
        self._world = frame
        self.add_time(frame, sim_time_ns)

    def add_time(self, frame: int, sim_time_ns: int) -> None:
        """Takes note of a frame's simulated time, which a frame without agents has not."""
        self._times_ns[frame] = sim_time_ns
        while len(self._times_ns) > 2 * MAX_OPEN_FRAMES:
            del self._times_ns[min(self._times_ns)]

    def add_roster(self, roster: Roster, received_ns: int) -> None:
        """Takes the list of agents that a process speaks for."""
        part = self._part(roster.frame, received_ns)
        if part is None:
            return
        self._heard.add(roster.process)
        if self._has_room(len(part.rosters), len(roster.agents)):
            part.rosters[roster.process] = roster

    def add_pose(self, pose: AgentPose, received_ns: int) -> None:
        """Takes an agent's pose."""
        part = self._part(pose.frame, received_ns)
        if part is not None and self._has_room(len(part.poses), 1):
            self.add_time(pose.frame, pose.sim_time_ns)
            part.poses[pose.agent] = pose

    def add_piece(self, piece: Piece) -> None:
        """Takes a decoded chunk of a scan."""
        part = self._part(piece.frame, piece.received_ns)
        if part is None:
            return
        if len(part.pieces) >= MAX_PIECES or part.size_bytes + piece.points.nbytes > MAX_BYTES:
            self.drops["frame_too_large"] += 1
            return
        self.add_time(piece.frame, piece.sim_time_ns)
        part.size_bytes += piece.points.nbytes
        part.chunks[piece.agent] = piece.chunks
        part.pieces[piece.agent, piece.chunk] = piece

    def add_objects(self, objects: Objects, received_ns: int) -> None:
        """Takes what an agent detected for itself."""
        part = self._part(objects.frame, received_ns)
        if part is not None and self._has_room(len(part.objects), 1):
            self.add_time(objects.frame, objects.sim_time_ns)
            part.objects[objects.agent] = objects

    def wants(self, frame: int) -> bool:
        """Whether a frame is still open; counts what comes late or is made up.

        What comes late of a frame that had enough was on its way already.
        """
        if self._world is not None and frame > self._world + MAX_AHEAD:
            self.drops["ahead"] += 1
            return False
        if frame <= self._finished and frame not in self._had_enough:
            self.drops["late"] += 1
        return frame > self._finished

    def wants_scan(self, scan: Scan) -> bool:
        """Whether a chunk is worth decoding: the first of its kind, of a frame that is open."""
        if not self.wants(scan.frame):
            return False
        part = self._open.get(scan.frame)
        chunks = part.chunks.get(scan.agent, scan.chunks) if part else scan.chunks
        if chunks != scan.chunks or scan.chunk >= chunks:
            self.drops["odd_chunk"] += 1
            return False
        if part is not None and (scan.agent, scan.chunk) in part.pieces:
            self.drops["repeated"] += 1
            return False
        return True

    def pop(self, now_ns: int) -> Frame | None:
        """Returns the newest whole frame, else the oldest that has been waited for long enough.

        Older frames than the one returned are given up.
        """
        whole = [number for number, part in self._open.items() if self._has_all(number, part)]
        old = [n for n, p in self._open.items() if now_ns - p.first_ns > self._wait_ns]
        if not whole and not old:
            return None
        number = max(whole) if whole else min(old)
        part = self._open.pop(number)
        for passed in [n for n in self._open if n < number]:
            del self._open[passed]
            self.drops["frame_given_up"] += 1
        self._finished = number
        if whole and not self._came_whole(part):
            self._had_enough.append(number)
        self.drops["frame_incomplete"] += not whole
        return self._close(number, part, complete=bool(whole), now_ns=now_ns)

    def _part(self, frame: int, received_ns: int) -> _OpenFrame | None:
        if not self.wants(frame):
            return None
        if frame not in self._open:
            self._open[frame] = _OpenFrame(received_ns)
            if len(self._open) > MAX_OPEN_FRAMES:
                del self._open[min(self._open)]
                self.drops["frame_given_up"] += 1
        part = self._open.get(frame)
        if part is not None:
            part.first_ns = min(part.first_ns, received_ns)
        return part

    def _has_room(self, held: int, more: int) -> bool:
        has_room = held + more <= MAX_AGENTS
        self.drops["too_many_agents"] += not has_room
        return has_room

    def _has_all(self, number: int, part: _OpenFrame) -> bool:
        """Whether all that is needed of a frame is there."""
        awaited = self._alive & self._heard
        if number not in self._times_ns or not awaited <= part.rosters.keys():
            return False
        rosters = [roster for name, roster in part.rosters.items() if name in awaited]
        if not all(self._has_poses(part, roster) for roster in rosters):
            return False
        uploaded = {a: part.uploaded(a) for roster in rosters for a in roster.scanning}
        if all(scan.is_whole for scan in uploaded.values()):
            return True
        return self._covers is not None and self._covers(uploaded)

    @staticmethod
    def _came_whole(part: _OpenFrame) -> bool:
        scanning = [agent for roster in part.rosters.values() for agent in roster.scanning]
        return all(part.uploaded(agent).is_whole for agent in scanning)

    def _has_poses(self, part: _OpenFrame, roster: Roster) -> bool:
        is_post = self._roles.get(roster.process) == NO_POSE_ROLE
        return is_post or all(agent in part.poses for agent in roster.agents)

    def _close(self, number: int, part: _OpenFrame, *, complete: bool, now_ns: int) -> Frame:
        came = {*part.poses, *part.objects, *(agent for agent, _ in part.pieces)}
        latest_ns = max(self._times_ns.values(), default=0)
        return Frame(
            frame=number,
            sim_time_ns=self._times_ns.get(number, latest_ns),
            agents=sorted(came),
            poses=[part.poses[agent] for agent in sorted(part.poses)],
            pieces=[part.pieces[key] for key in sorted(part.pieces)],
            complete=complete,
            first_ns=part.first_ns,
            ready_ns=now_ns,
            scanning=sorted({a for roster in part.rosters.values() for a in roster.scanning}),
            objects=[part.objects[agent] for agent in sorted(part.objects)],
        )
