"""Puts together what belongs to one frame, and says when it is whole or when to stop waiting."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping

from edge_server.coverage import Uploaded
from edge_server.frame import Found, Frame, Piece
from edge_server.gathering import Gathering
from protocol.horizon import Horizon
from protocol.messages import AgentPose, Objects, Roster, Scan

MAX_OPEN_FRAMES = 4
MAX_PROCESSES = 256  # that were not expected
NO_POSE_ROLE = "infra"  # a post's place is in its scans


class Assembler:
    """Knows which processes live and waits for all that they announce, up to `wait_ns`.

    A process is waited for from the start if it was expected, else from its first roster on, until
    it vanishes or floods. Of scans, less may be enough: `covers` decides by how far each came.
    `drops` counts, by reason, what came in vain.
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
        self._had_enough: deque[int] = deque(maxlen=MAX_OPEN_FRAMES)
        self._expected = frozenset(expected)
        self._roles = dict(expected)
        self._alive: set[str] = set()
        self._heard = set(expected)
        self._open: dict[int, Gathering] = {}
        self._times_ns: dict[int, int] = {}
        self._finished = -1
        self._horizon = Horizon()
        self.drops: Counter[str] = Counter()

    def hear(self, process: str, role: str, *, alive: bool) -> None:
        """Takes note of a process that appeared or vanished; of too many no more are noted."""
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
        """Waits for none of these, who say more than is heard, until their next roster."""
        self._heard -= processes

    def is_there(self, process: str) -> bool:
        """Whether a process lives."""
        return process in self._alive

    def admits(self, frame: int) -> bool:
        """Whether a frame can be real, be it over."""
        return self._horizon.admits(frame)

    def add_time(self, frame: int, sim_time_ns: int) -> None:
        """Takes note of a frame's simulated time, as the signal's state has it."""
        self._horizon.follow(frame)
        if not self._is_near(frame):
            return
        self._times_ns[frame] = sim_time_ns
        if len(self._times_ns) > 2 * MAX_OPEN_FRAMES:
            del self._times_ns[self._horizon.farthest(self._times_ns)]

    def add_roster(self, roster: Roster, received_ns: int) -> None:
        """Takes the list of agents that a process speaks for; only of one that is there."""
        if roster.process not in self._alive:
            self.drops["absent_process"] += 1
        elif part := self._part(roster.frame, received_ns):
            self._heard.add(roster.process)
            part.add_roster(roster)

    def add_pose(self, pose: AgentPose, received_ns: int) -> None:
        """Takes an agent's pose."""
        if part := self._part(pose.frame, received_ns):
            part.add_pose(pose)

    def add_objects(self, objects: Objects, received_ns: int) -> None:
        """Takes what an agent detected for itself."""
        if part := self._part(objects.frame, received_ns):
            part.add_found(Found(objects, received_ns))

    def wants(self, scan: Scan, received_ns: int) -> bool:
        """Whether it is worth decoding a scan; counts it if not."""
        part = self._part(scan.frame, received_ns)
        return part is not None and part.wants(scan)

    def begin(self, scan: Scan) -> None:
        """Takes note that a scan that was wanted is being decoded: its frame's end waits for it."""
        if part := self._open.get(scan.frame):
            part.begin(scan)

    def forgo(self, scan: Scan) -> None:
        """Takes note that a scan could not be decoded, and not by its own fault."""
        if part := self._open.get(scan.frame):
            part.forgo(scan)

    def add_piece(self, piece: Piece) -> None:
        """Takes a chunk of a scan that was wanted, decoded."""
        if part := self._part(piece.frame, piece.received_ns):
            part.add_piece(piece)

    def pop(self, now_ns: int) -> Frame | None:
        """Returns the newest whole frame, else the oldest that has been waited for long enough.

        Older frames than the one returned are given up. What came of a frame in time is part of it:
        one that waited for long enough takes no more scans, but those that are being decoded.
        """
        credible = {n: part for n, part in self._open.items() if self._is_credible(n, part)}
        whole = [number for number, part in credible.items() if self._is_whole(number, part)]
        old = [n for n, part in credible.items() if now_ns - part.first_ns > self._wait_ns]
        if not whole and not old:
            return None
        number = max(whole) if whole else min(old)
        if not whole and self._open[number].opening:
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

    def _part(self, frame: int, received_ns: int) -> Gathering | None:
        if frame <= self._finished:
            # Of a frame that had enough, more may have been on its way.
            self.drops["late"] += frame not in self._had_enough
            return None
        if not self._is_near(frame):
            return None
        if frame not in self._open:
            self._open[frame] = Gathering(received_ns, self.drops)
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

    def _is_credible(self, number: int, part: Gathering) -> bool:
        """Whether more than a single message speaks for a frame: its end makes others late."""
        awaited = self._awaited
        said = len(awaited & part.rosters.keys())
        return number in self._times_ns or 2 * said > len(awaited)

    def _is_whole(self, number: int, part: Gathering) -> bool:
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

    def _uploaded(self, part: Gathering) -> dict[str, Uploaded]:
        """Returns how far the scans came of all that those who are awaited announced."""
        rosters = [part.rosters[name] for name in sorted(self._awaited & part.rosters.keys())]
        return {a: part.uploaded(a) for roster in rosters for a in roster.scanning}

    def _close(self, number: int, part: Gathering, *, complete: bool, now_ns: int) -> Frame:
        agents = part.named()
        latest_ns = max(self._times_ns.values(), default=0)
        own_ns = latest_ns if part.time_ns is None else part.time_ns
        return Frame(
            frame=number,
            sim_time_ns=self._times_ns.get(number, own_ns),
            agents=agents,
            poses=[part.poses[agent] for agent in sorted(part.poses)],
            pieces=[part.pieces[key] for key in sorted(part.pieces)],
            complete=complete,
            first_ns=part.first_ns,
            ready_ns=now_ns,
            scanning=sorted({a for roster in part.rosters.values() for a in roster.scanning}),
            found=[part.found[agent] for agent in sorted(part.found)],
        )
