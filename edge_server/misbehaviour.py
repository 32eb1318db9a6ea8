"""How far an agent is believed, from one frame to the next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from edge_server.config import PlausibilityConfig
from edge_server.confirmation import Confirmation, Confirmed, Witness
from edge_server.frame import Chunk, Frame
from edge_server.map_consistency import MapConsistency, height, within
from edge_server.motion import MOST_STD_M, ClaimedPose, MotionCheck, fastest_mps
from edge_server.views import Squares, View, Viewer
from perception.arrays import Floats
from perception.parallel import each
from perception.roadway import Placed, Roadway
from protocol.geometry import wrap_angle
from protocol.messages import AgentPose, Doubt, Equipment
from protocol.roadmap import RoadMap

FALL = 0.3  # how much of a worse frame's score is taken over
RISE = 0.05  # of a better one's: who was caught is believed again only after a while
BACK = 0.2  # how far over the threshold the score must rise


class TrustScore:
    """A mean over frames that falls fast and rises slowly, and a yes or no with hysteresis.

    Whoever is new is believed. One odd frame does not change that; one in four does.
    """

    __slots__ = ("_threshold", "is_believed", "score")

    def __init__(self, threshold: float) -> None:
        self._threshold = threshold
        self.score = 1.0
        self.is_believed = True

    def add(self, score: float) -> None:
        """Takes a frame's score, 0 to 1."""
        self.score += (FALL if score < self.score else RISE) * (score - self.score)
        mark = self._threshold if self.is_believed else self._threshold + BACK
        self.is_believed = self.score >= min(mark, 0.99)


MOUNT_M, MOUNT_RAD = 1.5, np.radians(5.0)  # between a post's sensor and its mount in the scenario
KEEP = 0.85  # of what others said of an agent, from frame to frame
LEAST_SQUARES = 60.0  # that they must have spoken of
BENEFIT = 30.0  # squares more that are taken to agree: few prove less
CONTRADICTED, CONFIRMED = 0.78, 0.88  # shares of them that make a score of 0 and of 1
EXACT_STD_M = 0.1  # who is less sure of its place can neither confirm nor be confirmed
POST_LEAST = 0.5  # a post is not left out for what vehicles say
MOST_SILENCED = 8  # agents a frame whose word is taken from them at once
SEEN_THROUGH, DOUBTED = 0.7, 0.5  # of a place: scores of 0 and of 1
CV_WEIGHT, CAV_WEIGHT = 0.5, 1.0  # of a mere claim to be somewhere
FORGET_NS = 30_000_000_000
MOST_KNOWN = 1024  # twice as many as a frame may have
MOST_DOUBTS = 128  # of a frame are told
TOLD_STEP = 0.1  # smaller changes of a score are not told


EVIDENCE = ("motion", "place", "ground", "mutual")


@dataclass(slots=True)
class Evidence:
    """What speaks for an agent in one frame; None where nothing does, for or against."""

    motion: float | None = None
    place: float | None = None
    ground: float | None = None
    mutual: float | None = None

    @property
    def score(self) -> float:
        """The least."""
        known = (self.motion, self.place, self.ground, self.mutual)
        return min((one for one in known if one is not None), default=1.0)

    @property
    def worst(self) -> str:
        """The name of the least."""
        return next((name for name in EVIDENCE if getattr(self, name) == self.score), "nothing")


@dataclass(slots=True, eq=False)
class _Known:
    """What is remembered of an agent; `squares` and `total` are of what others said."""

    trust: TrustScore
    motion: MotionCheck = field(default_factory=MotionCheck)
    squares: float = 0.0
    total: float = 0.0
    seen_ns: int = 0
    told: tuple[float, bool] = (1.0, True)
    why: str = ""

    def share_with(self, said: Confirmed) -> float | None:
        """Returns the share that agrees, this frame included; None as long as little was said."""
        squares = KEEP * self.squares + said.squares
        if squares < LEAST_SQUARES:
            return None
        return (KEEP * self.total + said.total + BENEFIT) / (squares + BENEFIT)


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A frame without what is not believed, and why; `doubts` tell of scores that changed."""

    frame: Frame
    left_out: Counter[str]
    doubts: list[Doubt]


@dataclass(frozen=True, slots=True, eq=False)
class _Said:
    """All that one agent said in a frame."""

    agent: str
    pose: AgentPose | None
    chunks: list[Chunk]

    @property
    def sensor_pose(self) -> Floats | None:
        return self.chunks[0].sensor_pose if self.chunks else None

    @property
    def std_m(self) -> float:
        """How far it says that it may be off."""
        return 0.0 if self.pose is None else min(self.pose.position_std_m, MOST_STD_M)

    @property
    def is_of_one_place(self) -> bool:
        return all((p.sensor_pose == self.chunks[0].sensor_pose).all() for p in self.chunks)


class Plausibility:
    """Remembers agents from frame to frame; `posts` are x, y and yaw (3,) of the known mounts."""

    def __init__(
        self,
        road_map: RoadMap,
        roadway: Roadway,
        config: PlausibilityConfig,
        posts: Mapping[str, Floats],
    ) -> None:
        self._threshold = config.threshold
        self._posts = posts
        self._fast_mps = fastest_mps([lane.speed_mps for lane in road_map.lanes])
        self._whereabouts = MapConsistency(road_map, roadway)
        squares = Squares.of(roadway)
        self._viewer, self._confirmation = Viewer(squares), Confirmation(squares)
        self._known: dict[str, _Known] = {}

    def judge(self, frame: Frame) -> Judged:
        """Takes a frame whose pieces are placed; frames come in the order of their time."""
        said = _by_agent(frame)
        for one in said:
            self._remember(one.agent, frame.sim_time_ns)
        evidence = {one.agent: self._alone(one, frame.sim_time_ns) for one in said}
        self._together(said, evidence)
        for agent, found in evidence.items():
            known = self._known[agent]
            known.trust.add(found.score)
            if found.score < self._threshold:
                known.why = found.worst
        outcasts = {agent for agent in evidence if not self._known[agent].trust.is_believed}
        left_out = Counter(f"implausible_{self._known[agent].why}" for agent in outcasts)
        return Judged(_without(frame, outcasts), left_out, self._doubts(evidence))

    def view(self, parts: Sequence[Placed], sensor_pose: Floats) -> View:
        """Returns what a cloud in parts shows, seen from a pose (6,); for any thread."""
        return self._viewer.view(parts, sensor_pose[:3])

    def _remember(self, agent: str, now_ns: int) -> None:
        """Begins or goes on with an agent, and forgets those of whom nothing came for long."""
        known = self._known.pop(agent, None)
        if known is None or now_ns - known.seen_ns > FORGET_NS:
            known = _Known(TrustScore(self._threshold))
        known.seen_ns = now_ns
        self._known[agent] = known
        if len(self._known) > MOST_KNOWN:
            del self._known[next(iter(self._known))]

    def _alone(self, said: _Said, now_ns: int) -> Evidence:
        """Returns what an agent's own words say of it."""
        found = Evidence()
        known, pose, sensor_pose = self._known[said.agent], said.pose, said.sensor_pose
        is_post = said.agent in self._posts
        stand: ClaimedPose | None = None
        if not is_post:
            stand = ClaimedPose.of(now_ns, pose, sensor_pose)
        elif sensor_pose is not None:
            stand = ClaimedPose.of_post(now_ns, sensor_pose)
            found.place = _at_mount(sensor_pose, self._posts[said.agent])
        if stand is not None:
            found.motion = known.motion.score(stand, self._fast_mps)
        if not said.is_of_one_place:
            found.motion = 0.0
        if pose is not None and not is_post:
            found.place = self._whereabouts.on_road(pose.pose, said.std_m)
        if sensor_pose is not None:
            found.ground = self._ground(said, sensor_pose[:3], is_post=is_post)
        return found

    def _ground(self, said: _Said, sensor_m: Floats, *, is_post: bool) -> float | None:
        over_m = self._whereabouts.over_road_m(sensor_m)
        bare = any(chunk.ground_free for chunk in said.chunks)
        parts = [p.placed for p in said.chunks if p.placed is not None]
        ground = None if bare else self._whereabouts.on_ground(parts, sensor_m, said.std_m)
        if not bare and over_m is not None and _is_empty(said.chunks):
            ground = 0.0  # whoever stands on the road sees the road
        both = (None if is_post else height(over_m), ground)
        return min((one for one in both if one is not None), default=None)

    def _together(self, said: Sequence[_Said], evidence: dict[str, Evidence]) -> None:
        """Adds what the agents say of one another."""
        shown = [one for one in said if one.chunks and one.std_m <= EXACT_STD_M]
        if not shown or len(said) < 2:
            return
        views = each(self._view, shown)
        witnesses = [
            self._witness(one, view, evidence[one.agent])
            for one, view in zip(shown, views, strict=True)
        ]
        confirmed = self._confirmation.weigh(witnesses)
        for _ in range(MOST_SILENCED):
            liar = self._liar(shown, witnesses, confirmed)
            if liar is None:
                break
            witnesses[liar] = replace(witnesses[liar], belief=0.0)
            confirmed = self._confirmation.weigh(witnesses)
        for one, what in zip(shown, confirmed, strict=True):
            known = self._known[one.agent]
            share = known.share_with(what)
            known.squares = KEEP * known.squares + what.squares
            known.total = KEEP * known.total + what.total
            if share is not None:
                score = within((share - CONTRADICTED) / (CONFIRMED - CONTRADICTED))
                is_post = one.agent in self._posts
                evidence[one.agent].mutual = max(score, POST_LEAST) if is_post else score
        for one in said:
            if one.pose is not None and one.pose.equipment is not Equipment.NONE:
                self._look_at(one.pose, evidence[one.agent])

    def _view(self, said: _Said) -> View:
        if len(said.chunks) == 1 and said.chunks[0].view is not None:
            return said.chunks[0].view
        parts = [chunk.placed for chunk in said.chunks if chunk.placed is not None]
        return self.view(parts, said.chunks[0].sensor_pose)

    def _witness(self, said: _Said, view: View, evidence: Evidence) -> Witness:
        trust = self._known[said.agent].trust
        return Witness(
            view,
            is_post=said.agent in self._posts,
            belief=trust.score * evidence.score if trust.is_believed else 0.0,
        )

    def _liar(
        self, shown: Sequence[_Said], witnesses: Sequence[Witness], confirmed: Sequence[Confirmed]
    ) -> int | None:
        """Returns who is contradicted most of those whose word still counts, if that is enough.

        Its word is worth nothing then, so that the others are not doubted for it.
        """
        shares = []
        for index, one in enumerate(shown):
            share = self._known[one.agent].share_with(confirmed[index])
            speaks = witnesses[index].belief > 0 and not witnesses[index].is_post
            if speaks and share is not None and share < CONFIRMED:
                shares.append((share, one.agent, index))
        return min(shares)[2] if shares else None

    def _look_at(self, pose: AgentPose, evidence: Evidence) -> None:
        """Asks whether others see the road where a vehicle says that it stands."""
        weight = CAV_WEIGHT if pose.equipment is Equipment.CAV else CV_WEIGHT
        through = self._confirmation.seen_through(pose, weight)
        if through > 0:
            score = within((SEEN_THROUGH - through) / (SEEN_THROUGH - DOUBTED))
            evidence.mutual = score if evidence.mutual is None else min(evidence.mutual, score)

    def _doubts(self, evidence: Mapping[str, Evidence]) -> list[Doubt]:
        """Returns the agents to be told of: those left out, and those whose score has changed.

        Where they are many, those that are believed least.
        """
        doubts: list[Doubt] = []
        for agent, found in sorted(evidence.items(), key=self._rank):
            known = self._known[agent]
            now = known.trust.score, known.trust.is_believed
            changed = abs(now[0] - known.told[0]) >= TOLD_STEP or now[1] != known.told[1]
            if not changed and now[1]:
                continue
            if len(doubts) >= MOST_DOUBTS:
                break
            known.told = now
            scores = (found.motion, found.place, found.ground, found.mutual)
            motion, place, ground, mutual = (s and round(s, 3) for s in scores)
            doubts.append(
                Doubt(
                    agent=agent,
                    score=round(now[0], 3),
                    believed=now[1],
                    motion=motion,
                    place=place,
                    ground=ground,
                    mutual=mutual,
                )
            )
        return doubts

    def _rank(self, item: tuple[str, Evidence]) -> tuple[float, str]:
        return self._known[item[0]].trust.score, item[0]


def _by_agent(frame: Frame) -> list[_Said]:
    poses = {pose.agent: pose for pose in frame.poses}
    chunks: dict[str, list[Chunk]] = {}
    for chunk in frame.chunks:
        chunks.setdefault(chunk.agent, []).append(chunk)
    return [_Said(agent, poses.get(agent), chunks.get(agent, [])) for agent in frame.agents]


def _without(frame: Frame, outcasts: set[str]) -> Frame:
    if not outcasts:
        return frame
    return replace(
        frame,
        agents=[agent for agent in frame.agents if agent not in outcasts],
        poses=[pose for pose in frame.poses if pose.agent not in outcasts],
        chunks=[chunk for chunk in frame.chunks if chunk.agent not in outcasts],
        found=[one for one in frame.found if one.agent not in outcasts],
    )


def _at_mount(sensor_pose: Floats, mount: Floats) -> float:
    """Returns 1 if a post's sensor (6,) is where the scenario has its mount (3,), else 0."""
    off_m = float(np.hypot(*(sensor_pose[:2] - mount[:2])))
    turned_rad = abs(float(wrap_angle(sensor_pose[5] - mount[2])))
    return float(off_m <= MOUNT_M and turned_rad <= MOUNT_RAD)


def _is_empty(chunks: Sequence[Chunk]) -> bool:
    """Whether a whole scan, of which no plan cut anything away, holds nothing at all.

    One that does not decode is counted elsewhere; nobody can tell what it showed.
    """
    if any(chunk.is_undecodable for chunk in chunks):
        return False
    is_whole = len(chunks) == chunks[0].chunk_count and all(p.plan_frame < 0 for p in chunks)
    return is_whole and not any(chunk.returns for chunk in chunks)
