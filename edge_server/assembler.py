"""Frame assembly: collects a frame's poses and chunks, decides when it is complete or timed out."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from edge_server.completion import UploadProgress
from edge_server.frame import AgentDetections, Chunk, Frame
from protocol.messages import AgentPose, Objects, Roster, Scan
from protocol.sequence_window import SequenceWindow

K = TypeVar("K")
V = TypeVar("V")

MAX_AGENTS = 512  # of a frame
MAX_CHUNKS = 4 * MAX_AGENTS
MAX_BOXES = 4 * MAX_AGENTS  # that agents detected on board
MAX_POINTS = 10_000_000  # of a frame; placed, they take 160 MB


@dataclass(slots=True, eq=False)
class FrameAssembly:
    """A frame that is being assembled. Chunks are identified by (agent, index).

    `decoding` are the chunks that are wanted and not decoded yet. A frame that `is_closing` takes
    no more. Where there is no room, an agent that no roster announces gives way to one that is
    announced. `drops` counts, by reason, what was not used.
    """

    first_ns: int
    drops: Counter[str]
    time_ns: int | None = None
    rosters: dict[str, Roster] = field(default_factory=dict)
    poses: dict[str, AgentPose] = field(default_factory=dict)
    chunks: dict[tuple[str, int], Chunk] = field(default_factory=dict)
    chunk_counts: dict[str, int] = field(default_factory=dict)
    found: dict[str, AgentDetections] = field(default_factory=dict)
    decoding: set[tuple[str, int]] = field(default_factory=set)
    is_closing: bool = False

    def add_roster(self, roster: Roster) -> None:
        """Adds a process's first roster."""
        held = sum(_size(other) + 1 for other in self.rosters.values())
        if roster.process in self.rosters:
            self.drops["duplicate"] += 1
        elif held + _size(roster) > MAX_AGENTS:
            self.drops["too_many_agents"] += 1
        else:
            self.rosters[roster.process] = roster

    def add_pose(self, pose: AgentPose) -> None:
        """Adds an agent's first pose."""
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

    def add_found(self, found: AgentDetections) -> None:
        """Adds an agent's first boxes."""
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
        """Whether a chunk is new, agrees with the agent's others and has room; counts it if not."""
        key = scan.agent, scan.chunk
        if key in self.chunks or key in self.decoding:
            reason = "duplicate"
        elif self.is_closing:
            reason = "late"
        elif self.chunk_counts.get(scan.agent, scan.chunks) != scan.chunks:
            reason = "contradiction"
        elif len(self.chunks) >= MAX_CHUNKS and not self._can_oust_for(scan.agent):
            reason = "too_many_agents"
        else:
            return True
        self.drops[reason] += 1
        return False

    def begin(self, scan: Scan) -> None:
        """Marks a wanted chunk as being decoded."""
        self.decoding.add((scan.agent, scan.chunk))
        self.chunk_counts[scan.agent] = scan.chunks

    def forgo(self, scan: Scan) -> None:
        """Marks a chunk as one that could not be decoded."""
        self.decoding.discard((scan.agent, scan.chunk))

    def add_chunk(self, chunk: Chunk) -> None:
        """Adds a decoded chunk that was wanted."""
        self.decoding.discard((chunk.agent, chunk.index))
        while not self._fits(chunk) and self._can_oust_for(chunk.agent):
            self._oust(self.chunks, [key for key in self.chunks if not self._is_announced(key[0])])
        if not self._fits(chunk):
            self.drops["frame_too_large"] += 1
            return
        self.chunk_counts[chunk.agent] = chunk.chunk_count
        self.chunks[chunk.agent, chunk.index] = chunk
        self._date(chunk.sim_time_ns)

    def has_poses(self, roster: Roster) -> bool:
        """Whether all poses arrived that a roster announces."""
        return all(agent in self.poses for agent in roster.agents)

    def uploaded(self, agent: str) -> UploadProgress:
        """Returns how much of an agent's scan arrived; boxes of its own count as a whole scan."""
        if agent in self.found:
            return UploadProgress(1, 1, -1)
        chunks, came = self.chunk_counts.get(agent, 0), 0
        while came < chunks and (agent, came) in self.chunks:
            came += 1
        return UploadProgress(came, chunks, self.chunks[agent, 0].plan_frame if came else -1)

    def named(self) -> list[str]:
        """Returns the agents of which something arrived, sorted; announced ones first."""
        came = {*self.poses, *self.found, *(agent for agent, _ in self.chunks)}
        if len(came) > MAX_AGENTS:
            came = set(sorted(came, key=lambda a: (not self._is_announced(a), a))[:MAX_AGENTS])
        return sorted(came)

    def _is_announced(self, agent: str) -> bool:
        return any(agent in roster.agents for roster in self.rosters.values())

    def _can_oust_for(self, agent: str) -> bool:
        return self._is_announced(agent) and not all(self._is_announced(a) for a, _ in self.chunks)

    def _fits(self, chunk: Chunk) -> bool:
        returns = chunk.returns + sum(other.returns for other in self.chunks.values())
        return len(self.chunks) < MAX_CHUNKS and returns <= MAX_POINTS

    def _oust(self, held: dict[K, V], strangers: list[K]) -> None:
        if strangers:
            del held[strangers[-1]]
            self.drops["stranger_ousted"] += 1

    def _date(self, sim_time_ns: int) -> None:
        if self.time_ns is None:
            self.time_ns = sim_time_ns


def _size(roster: Roster) -> int:
    """Returns the number of entries in both lists of a roster."""
    return max(len(roster.agents), len(roster.scanning))


MAX_OPEN_FRAMES = 4
MAX_PROCESSES = 256  # that were not expected
NO_POSE_ROLE = "infra"  # a roadside unit's place is in its scans


class Assembler:
    """Assembles frames: waits for all that present processes announce, up to `wait_ns`.

    A process is waited for from the start if it was expected, else from its first roster on, until
    it vanishes or floods. Parts of scans may be enough: `covers` decides by how much of each has
    arrived. `drops` counts, by reason, what was not used.
    """

    def __init__(
        self,
        *,
        wait_ns: int,
        expected: dict[str, str],
        covers: Callable[[Mapping[str, UploadProgress]], bool] | None = None,
    ) -> None:
        self._wait_ns = wait_ns
        self._covers = covers
        self._had_enough: deque[int] = deque(maxlen=MAX_OPEN_FRAMES)
        self._expected = frozenset(expected)
        self._roles = dict(expected)
        self._alive: set[str] = set()
        self._heard = set(expected)
        self._open: dict[int, FrameAssembly] = {}
        self._times_ns: dict[int, int] = {}
        self._finished = -1
        self._horizon = SequenceWindow()
        self.drops: Counter[str] = Counter()

    def hear(self, process: str, role: str, *, alive: bool) -> None:
        """Adds a process that appeared or removes one that vanished; their number is bounded."""
        is_new = process not in self._roles
        if alive and is_new and len(self._roles) >= len(self._expected) + MAX_PROCESSES:
            self.drops["too_many_processes"] += 1
        elif alive:
            self._roles[process] = role
            self._alive.add(process)
        else:
            self._alive.discard(process)
            self._heard.discard(process)
            if process not in self._expected:
                self._roles.pop(process, None)

    def wait_not_for(self, processes: set[str]) -> None:
        """Stops waiting for processes that flood the inbox, until their next roster."""
        self._heard -= processes

    def is_there(self, process: str) -> bool:
        """Whether a process is alive."""
        return process in self._alive

    def admits(self, frame: int) -> bool:
        """Whether a frame number is plausible; the frame may be over."""
        return self._horizon.admits(frame)

    def add_time(self, frame: int, sim_time_ns: int) -> None:
        """Adds a frame's simulated time, from the signal's state."""
        self._horizon.follow(frame)
        if not self._is_near(frame):
            return
        self._times_ns[frame] = sim_time_ns
        if len(self._times_ns) > 2 * MAX_OPEN_FRAMES:
            del self._times_ns[self._horizon.farthest(self._times_ns)]

    def add_roster(self, roster: Roster, received_ns: int) -> None:
        """Adds the roster of a process, if that is present."""
        if roster.process not in self._alive:
            self.drops["absent_process"] += 1
        elif part := self._part(roster.frame, received_ns):
            self._heard.add(roster.process)
            part.add_roster(roster)

    def add_pose(self, pose: AgentPose, received_ns: int) -> None:
        """Adds an agent's pose."""
        if part := self._part(pose.frame, received_ns):
            part.add_pose(pose)

    def add_objects(self, objects: Objects, received_ns: int) -> None:
        """Adds objects that an agent detected on board."""
        if part := self._part(objects.frame, received_ns):
            part.add_found(AgentDetections(objects, received_ns))

    def wants(self, scan: Scan, received_ns: int) -> bool:
        """Whether it is worth decoding a scan; counts it if not."""
        part = self._part(scan.frame, received_ns)
        return part is not None and part.wants(scan)

    def begin(self, scan: Scan) -> None:
        """Marks a wanted scan as being decoded: the end of its frame waits for it."""
        if part := self._open.get(scan.frame):
            part.begin(scan)

    def forgo(self, scan: Scan) -> None:
        """Marks a scan as one that could not be decoded, through no fault of its own."""
        if part := self._open.get(scan.frame):
            part.forgo(scan)

    def add_chunk(self, chunk: Chunk) -> None:
        """Adds a wanted chunk of a scan, decoded."""
        if part := self._part(chunk.frame, chunk.received_ns):
            part.add_chunk(chunk)

    def pop(self, now_ns: int) -> Frame | None:
        """Returns the newest complete frame, else the oldest that has timed out.

        Frames older than the one returned are dropped. What arrived in time is part of a frame: one
        that timed out takes no more scans but those that are being decoded.
        """
        credible = {n: part for n, part in self._open.items() if self._is_credible(n, part)}
        whole = [number for number, part in credible.items() if self._is_whole(number, part)]
        old = [n for n, part in credible.items() if now_ns - part.first_ns > self._wait_ns]
        if not whole and not old:
            return None
        number = max(whole) if whole else min(old)
        if not whole and self._open[number].decoding:
            self._open[number].is_closing = True
            return None
        part = self._open.pop(number)
        for passed in [n for n in self._open if n < number]:
            self._give_up(passed)
        if whole and not all(scan.is_whole for scan in self._uploaded(part).values()):
            self._had_enough.append(number)
        self._finished = number
        self._horizon.reach(number)
        self.drops["frame_incomplete"] += not whole
        return self._close(number, part, complete=bool(whole), now_ns=now_ns)

    def _part(self, frame: int, received_ns: int) -> FrameAssembly | None:
        if frame <= self._finished:
            # More chunks of a frame that was complete may have been in transit.
            self.drops["late"] += frame not in self._had_enough
            return None
        if not self._is_near(frame):
            return None
        if frame not in self._open:
            self._open[frame] = FrameAssembly(received_ns, self.drops)
            if len(self._open) > MAX_OPEN_FRAMES:
                self._give_up(self._horizon.farthest(self._open))
        part = self._open.get(frame)
        if part is not None:
            part.first_ns = min(part.first_ns, received_ns)
        return part

    def _is_near(self, frame: int) -> bool:
        near = self._horizon.admits(frame)
        self.drops["far_frame"] += not near
        return near

    def _give_up(self, frame: int) -> None:
        del self._open[frame]
        self.drops["frame_given_up"] += 1

    @property
    def _awaited(self) -> set[str]:
        return self._alive & self._heard

    def _is_credible(self, number: int, part: FrameAssembly) -> bool:
        """Whether more than one message supports a frame number: its end makes others late."""
        awaited = self._awaited
        said = len(awaited & part.rosters.keys())
        return number in self._times_ns or 2 * said > len(awaited)

    def _is_whole(self, number: int, part: FrameAssembly) -> bool:
        awaited = self._awaited
        if number not in self._times_ns and part.time_ns is None:
            return False
        if not awaited <= part.rosters.keys():
            return False
        driving = [name for name in awaited if self._roles.get(name) != NO_POSE_ROLE]
        if not all(part.has_poses(part.rosters[name]) for name in driving):
            return False
        uploaded = self._uploaded(part)
        if all(scan.is_whole for scan in uploaded.values()):
            return True
        return self._covers is not None and self._covers(uploaded)

    def _uploaded(self, part: FrameAssembly) -> dict[str, UploadProgress]:
        """Returns how much has arrived of the announced scans."""
        rosters = [part.rosters[name] for name in sorted(self._awaited & part.rosters.keys())]
        return {a: part.uploaded(a) for roster in rosters for a in roster.scanning}

    def _close(self, number: int, part: FrameAssembly, *, complete: bool, now_ns: int) -> Frame:
        agents = part.named()
        latest_ns = max(self._times_ns.values(), default=0)
        own_ns = latest_ns if part.time_ns is None else part.time_ns
        return Frame(
            frame=number,
            sim_time_ns=self._times_ns.get(number, own_ns),
            agents=agents,
            poses=[part.poses[agent] for agent in sorted(part.poses)],
            chunks=[part.chunks[key] for key in sorted(part.chunks)],
            complete=complete,
            first_ns=part.first_ns,
            ready_ns=now_ns,
            scanning=sorted({a for roster in part.rosters.values() for a in roster.scanning}),
            found=[part.found[agent] for agent in sorted(part.found)],
        )
