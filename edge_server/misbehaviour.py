"""Misbehaviour detection: agents with implausible data are excluded from the frame.

Three checks of each agent in a frame give a score, 0 to 1, or None where there is nothing to check:
its motion, its position on the road, the ground in its cloud. The least of them is the frame's
score; a mean over frames decides. Nothing here reads a clock or depends on the order of arrival.
See docs/reliability.md for what it detects and what it does not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from edge_server.config import MisbehaviourConfig
from edge_server.frame import Chunk, Frame, FrameStage, FrameState
from edge_server.map_consistency import MapConsistency, height
from edge_server.motion import MOST_STD_M, ClaimedPose, MotionCheck
from perception.arrays import Floats
from perception.roadway import Roadway
from protocol.geometry import wrap_angle
from protocol.messages import AgentPose, AgentScore
from protocol.regions import RegionMap

FALL = 0.3  # share of a worse frame's score that enters the mean
RISE = 0.05  # of a better one's: an agent that was excluded returns only after a while
BACK = 0.2  # how far over the threshold the mean must rise to return
MOUNT_M, MOUNT_RAD = 1.5, np.radians(5.0)  # between a roadside sensor and its mount
FORGET_NS = 30_000_000_000
MAX_REMEMBERED = 1024  # agents, twice as many as a frame may have
MAX_PUBLISHED = 128  # scores of one frame
PUBLISHED_STEP = 0.1  # smaller changes of a score are not published


class TrustScore:
    """A mean over frames that falls fast and rises slowly, and a decision with hysteresis.

    A new agent is trusted. One odd frame does not change that; one in four does.
    """

    __slots__ = ("_threshold", "is_trusted", "score")

    def __init__(self, threshold: float) -> None:
        self._threshold = threshold
        self.score = 1.0
        self.is_trusted = True

    def add(self, score: float) -> None:
        """Takes a frame's score, 0 to 1."""
        self.score += (FALL if score < self.score else RISE) * (score - self.score)
        mark = self._threshold if self.is_trusted else self._threshold + BACK
        self.is_trusted = self.score >= min(mark, 0.99)


@dataclass(slots=True)
class Evidence:
    """Scores of an agent's checks in one frame; None where there is nothing to check."""

    motion: float | None = None
    place: float | None = None
    ground: float | None = None

    @property
    def score(self) -> float:
        """The least score."""
        known = (self.motion, self.place, self.ground)
        return min((one for one in known if one is not None), default=1.0)

    @property
    def worst(self) -> str:
        """The name of the check with the least score."""
        names = ("motion", "place", "ground")
        return next((name for name in names if getattr(self, name) == self.score), "nothing")


@dataclass(slots=True, eq=False)
class _Remembered:
    """State of an agent, kept from frame to frame."""

    trust: TrustScore
    motion: MotionCheck = field(default_factory=MotionCheck)
    seen_ns: int = 0
    published: tuple[float, bool] = (1.0, True)
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class _Sent:
    """All that one agent sent in a frame."""

    agent: str
    pose: AgentPose | None
    chunks: list[Chunk]

    @property
    def sensor_pose(self) -> Floats | None:
        return self.chunks[0].sensor_pose if self.chunks else None

    @property
    def std_m(self) -> float:
        """Standard deviation of its position, as it claims."""
        return 0.0 if self.pose is None else min(self.pose.position_std_m, MOST_STD_M)

    @property
    def is_from_one_place(self) -> bool:
        return all((c.sensor_pose == self.chunks[0].sensor_pose).all() for c in self.chunks)


class Check(FrameStage):
    """Stage that scores agents; `mounts` are x, y, yaw (3,) of the roadside units, by agent."""

    name = "check"

    def __init__(
        self,
        region: RegionMap,
        roadway: Roadway,
        config: MisbehaviourConfig,
        mounts: Mapping[str, Floats],
    ) -> None:
        self._threshold = config.threshold
        self._mounts = mounts
        self._map = MapConsistency(region, roadway)
        self._remembered: dict[str, _Remembered] = {}

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        frame, evidence = state.frame, dict[str, Evidence]()
        for sent in _by_agent(frame):
            known = self._remember(sent.agent, frame.sim_time_ns)
            found = self._evidence(sent, known, frame.sim_time_ns)
            known.trust.add(found.score)
            if found.score < self._threshold:
                known.reason = found.worst
            evidence[sent.agent] = found
        excluded = {a for a in evidence if not self._remembered[a].trust.is_trusted}
        state.excluded.update(f"implausible_{self._remembered[a].reason}" for a in excluded)
        state.distrusted |= excluded
        state.scores += self._changed(evidence)
        state.frame = frame.without(excluded)

    def _remember(self, agent: str, now_ns: int) -> _Remembered:
        """Returns an agent's state, a new one if nothing was received of it for long."""
        known = self._remembered.pop(agent, None)
        if known is None or now_ns - known.seen_ns > FORGET_NS:
            known = _Remembered(TrustScore(self._threshold))
        known.seen_ns = now_ns
        self._remembered[agent] = known
        if len(self._remembered) > MAX_REMEMBERED:
            del self._remembered[next(iter(self._remembered))]
        return known

    def _evidence(self, sent: _Sent, known: _Remembered, now_ns: int) -> Evidence:
        found = Evidence()
        pose, sensor_pose, mount = sent.pose, sent.sensor_pose, self._mounts.get(sent.agent)
        claimed: ClaimedPose | None = None
        if mount is None:
            claimed = ClaimedPose.of(now_ns, pose, sensor_pose)
        elif sensor_pose is not None:
            claimed = ClaimedPose.of_rsu(now_ns, sensor_pose)
            found.place = _at_mount(sensor_pose, mount)
        if claimed is not None:
            fast_mps = self._map.fastest_mps(claimed.pose)
            found.motion = known.motion.score(claimed, fast_mps)
        if not sent.is_from_one_place:
            found.motion = 0.0
        if pose is not None and mount is None:
            found.place = self._map.on_road(pose.pose, sent.std_m)
        if sensor_pose is not None:
            found.ground = self._ground(sent, sensor_pose[:3], is_rsu=mount is not None)
        return found

    def _ground(self, sent: _Sent, sensor_m: Floats, *, is_rsu: bool) -> float | None:
        over_m = self._map.over_road_m(sensor_m)
        bare = any(chunk.ground_free for chunk in sent.chunks)
        parts = [chunk.placed for chunk in sent.chunks if chunk.placed is not None]
        ground = None if bare else self._map.on_ground(parts, sensor_m, sent.std_m)
        if not bare and over_m is not None and _is_empty(sent.chunks):
            ground = 0.0  # a sensor on the road measures the road
        both = (None if is_rsu else height(over_m), ground)
        return min((one for one in both if one is not None), default=None)

    def _changed(self, evidence: Mapping[str, Evidence]) -> list[AgentScore]:
        """Returns scores to publish: of excluded agents, and those that have changed.

        Where they are many, the lowest ones.
        """
        scores: list[AgentScore] = []
        for agent, found in sorted(evidence.items(), key=self._rank):
            known = self._remembered[agent]
            score, is_trusted = now = known.trust.score, known.trust.is_trusted
            step = abs(score - known.published[0])
            if is_trusted and known.published[1] and step < PUBLISHED_STEP:
                continue
            if len(scores) >= MAX_PUBLISHED:
                break
            known.published = now
            motion, place, ground = (
                one and round(one, 3) for one in (found.motion, found.place, found.ground)
            )
            scores.append(
                AgentScore(
                    agent=agent,
                    score=round(score, 3),
                    trusted=is_trusted,
                    motion=motion,
                    place=place,
                    ground=ground,
                )
            )
        return scores

    def _rank(self, item: tuple[str, Evidence]) -> tuple[float, str]:
        return self._remembered[item[0]].trust.score, item[0]


def _by_agent(frame: Frame) -> list[_Sent]:
    poses = {pose.agent: pose for pose in frame.poses}
    chunks: dict[str, list[Chunk]] = {}
    for chunk in frame.chunks:
        chunks.setdefault(chunk.agent, []).append(chunk)
    return [_Sent(agent, poses.get(agent), chunks.get(agent, [])) for agent in frame.agents]


def _at_mount(sensor_pose: Floats, mount: Floats) -> float:
    """Returns 1 if a roadside sensor (6,) is where the scenario has its mount (3,), else 0."""
    off_m = float(np.hypot(*(sensor_pose[:2] - mount[:2])))
    turned_rad = abs(float(wrap_angle(sensor_pose[5] - mount[2])))
    return float(off_m <= MOUNT_M and turned_rad <= MOUNT_RAD)


def _is_empty(chunks: Sequence[Chunk]) -> bool:
    """Whether a whole scan, of which no plan cut anything away, holds no point.

    One that cannot be decoded is counted elsewhere; its content is unknown.
    """
    if any(chunk.is_undecodable for chunk in chunks):
        return False
    is_whole = len(chunks) == chunks[0].chunk_count and all(c.plan_frame < 0 for c in chunks)
    return is_whole and not any(chunk.returns for chunk in chunks)
