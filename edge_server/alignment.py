"""Pose alignment: agents' pose errors, estimated by scan registration and corrected.

Every few frames an agent's scan is registered to the static map of the scene, which is learnt from
roadside units and from agents whose poses are right. From that, a Kalman filter for each agent
estimates the slowly varying offset of its poses; directions that the scene does not constrain keep
their estimate. Scans and poses are corrected by it before they are merged. An agent whose scans
contradict the map at any offset is excluded.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from edge_server.frame import Chunk, ChunkStage, Frame, FrameStage, FrameState
from edge_server.static_map import Fit, StaticMap, structure
from perception.arrays import Floats, Floats32
from perception.roadway import Placed, Roadway
from protocol.geometry import euler_rotation
from protocol.messages import AgentAlignment, AgentPose

EVERY = 5  # frames: an agent's scan is registered
ADD_FIRST, ADD_EVERY = 5, 4  # of an agent's scans that are in place: go into the map
COARSE_M, FINE_M = 3.0, 0.4  # from the map: what is drawn to it, at first and later
LEAST_KNOWN = 100  # points: fewer are not informative
GOOD, CONTRADICTS = 0.6, 0.4  # share of inliers of a fit that counts, of one that is none at all
# Standard deviations of x, y, z in m and yaw in rad: of the offset of an unknown agent, the noise
# of a frame's pose, the offset's change in the root of a second, and of one that is known well.
PRIOR_STD = np.array([0.3, 0.3, 0.2, np.radians(1.0)])
NOISE_STD = np.array([0.05, 0.05, 0.05, np.radians(0.1)])
DRIFT_STD = np.array([0.05, 0.05, 0.02, np.radians(0.05)])
KNOWN_STD = np.array([0.1, 0.1, 0.1, np.radians(0.15)])
SURPRISE = 4.0  # standard deviations: the agent has relocalised
MISFIT_SHARE = 0.2  # of a registration that enters the mean
EXCLUDED, BACK = (
    0.6,
    0.3,
)  # mean of contradictions above which an agent goes, below which it returns
FORGET_NS = 30_000_000_000
MOST_AGENTS = 1024


class Sample(ChunkStage):
    """Extracts the structure of those scans that are registered in their frame."""

    name = "sample"

    def __init__(self, roadway: Roadway) -> None:
        self._roadway = roadway

    def run(self, chunk: Chunk) -> Chunk:
        """See `ChunkStage.run`."""
        if (chunk.frame + zlib.crc32(chunk.agent.encode())) % EVERY or not len(chunk.points):
            return chunk
        found = structure(chunk.points, chunk.sensor_pose, self._roadway)
        return replace(chunk, structure=found)


class OffsetFilter:
    """Kalman filter of the offset of an agent's poses: x, y, z in m, yaw in rad (4,)."""

    __slots__ = ("_covariance", "offset", "updates")

    def __init__(self) -> None:
        self.offset: Floats = np.zeros(4)
        self._covariance: Floats = np.diag(PRIOR_STD**2)
        self.updates = 0

    @property
    def std(self) -> Floats:
        """Standard deviations (4,) of the offset."""
        return np.sqrt(np.diag(self._covariance))

    @property
    def is_known(self) -> bool:
        """Whether the offset is known well along all directions."""
        return bool((self.std < KNOWN_STD).all())

    def predict(self, by_s: float) -> None:
        """Predicts over a time step."""
        covariance = self._covariance + np.diag(DRIFT_STD**2) * by_s
        scale = np.minimum(PRIOR_STD / np.sqrt(np.diag(covariance)), 1.0)
        self._covariance = covariance * scale[:, None] * scale

    def update(self, fit: Fit) -> None:
        """Updates by a registration. An implausible one resets the filter around it."""
        noise = fit.covariance + np.diag(NOISE_STD**2)
        surprise = fit.offset - self.offset
        surprise[3] = np.remainder(surprise[3] + np.pi, 2 * np.pi) - np.pi
        expected = np.sqrt(np.diag(self._covariance + noise))
        if (np.abs(surprise) > SURPRISE * expected).any():
            self._covariance = self._covariance + np.diag(PRIOR_STD**2)
        gain = self._covariance @ np.linalg.inv(self._covariance + noise)
        self.offset = self.offset + gain @ surprise
        left = np.eye(4) - gain
        self._covariance = left @ self._covariance @ left.T + gain @ noise @ gain.T
        self.updates += 1


@dataclass(slots=True, eq=False)
class _Known:
    """State of an agent, kept from frame to frame."""

    filter: OffsetFilter = field(default_factory=OffsetFilter)
    seen_ns: int = 0
    misfit: float = 0.0
    is_excluded: bool = False
    added: int = 0

    def adds(self) -> bool:
        """Whether this scan is added to the map: the first ones, later every fourth."""
        self.added += 1
        return self.added <= ADD_FIRST or self.added % ADD_EVERY == 0

    def judge(self, fit: Fit) -> None:
        """Updates whether the agent's scans contradict the map; a single one does not decide."""
        contradicts = float(fit.inliers < CONTRADICTS)
        self.misfit += MISFIT_SHARE * (contradicts - self.misfit)
        self.is_excluded = self.misfit > (BACK if self.is_excluded else EXCLUDED)


class Align(FrameStage):
    """Stage that corrects scans and poses; keeps the static map and agents' offsets.

    Roadside units were surveyed: they are never moved, and the map begins with what they see.
    Without any in a frame it begins with what the first agent sees.
    """

    name = "align"

    def __init__(self, mounts: Collection[str]) -> None:
        self._fixed = set(mounts)
        self._first: str | None = None
        self._map = StaticMap()
        self._known: dict[str, _Known] = {}

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        frame, excluded = state.frame, set[str]()
        self._choose_first(frame)
        for agent in frame.agents:
            known = self._remember(agent, frame.sim_time_ns)
            chunks = [c for c in frame.chunks if c.agent == agent and c.structure is not None]
            if chunks:
                fit = self._register(agent, known, chunks)
                state.alignments += [_published(agent, known, fit)] if fit else []
            excluded |= {agent} if known.is_excluded else set()
        state.excluded.update("misaligned" for _ in excluded)
        state.distrusted |= excluded
        state.frame = self._corrected(frame.without(excluded))

    def _choose_first(self, frame: Frame) -> None:
        """Chooses whose scans begin the map while there is none and no roadside unit."""
        scanning = dict.fromkeys(chunk.agent for chunk in frame.chunks)
        if self._map.is_ready or not self._fixed.isdisjoint(frame.agents):
            self._first = None
        elif self._first not in scanning:
            self._first = next(iter(scanning), None)

    def _remember(self, agent: str, now_ns: int) -> _Known:
        known = self._known.pop(agent, None)
        if known is None or not 0 <= now_ns - known.seen_ns <= FORGET_NS:
            known = _Known(seen_ns=now_ns)
        known.filter.predict((now_ns - known.seen_ns) / 1e9)
        known.seen_ns = now_ns
        self._known[agent] = known
        if len(self._known) > MOST_AGENTS:
            del self._known[next(iter(self._known))]
        return known

    def _register(self, agent: str, known: _Known, chunks: list[Chunk]) -> Fit | None:
        """Registers a scan, and adds it to the map if it is in place."""
        points: Floats32 = np.concatenate([c.structure for c in chunks if c.structure is not None])
        sensor_m = chunks[0].sensor_pose[:3]
        if agent in self._fixed or agent == self._first:
            if known.adds():
                self._map.add(points + sensor_m)
            return None
        if not self._map.is_ready or len(points) < LEAST_KNOWN:
            return None
        fit = self._fit(known, points, sensor_m)
        if fit.known < LEAST_KNOWN:
            return fit
        known.judge(fit)
        if fit.inliers >= GOOD:
            known.filter.update(fit)
            if known.filter.is_known and known.adds():
                turn = euler_rotation(0.0, 0.0, -known.filter.offset[3])
                self._map.add(points @ turn.T + sensor_m - known.filter.offset[:3])
        return fit

    def _fit(self, known: _Known, points: Floats32, sensor_m: Floats) -> Fit:
        """Registers a scan from the known offset; with a larger search radius where that fails."""
        if known.filter.updates:
            fit = self._map.fit(points, sensor_m, known.filter.offset, FINE_M)
            if fit.known < LEAST_KNOWN or fit.inliers >= GOOD:
                return fit
        else:
            fit = self._map.fit(points, sensor_m, known.filter.offset, 0.0)
            if fit.known < LEAST_KNOWN / 2:
                return fit
        coarse = self._map.fit(points, sensor_m, known.filter.offset, COARSE_M)
        return self._map.fit(points, sensor_m, coarse.offset, FINE_M)

    def _corrected(self, frame: Frame) -> Frame:
        """Returns the frame with corrected scans and poses."""
        offsets = {a: k.filter.offset for a, k in self._known.items() if k.filter.updates}
        return replace(
            frame,
            chunks=[_moved(c, offsets[c.agent]) if c.agent in offsets else c for c in frame.chunks],
            poses=[_back(p, offsets[p.agent]) if p.agent in offsets else p for p in frame.poses],
        )


def _without(pose: Floats, offset: Floats) -> Floats:
    """Returns a pose (6,) without the offset (4,)."""
    return np.asarray(pose - np.array([*offset[:3], 0.0, 0.0, offset[3]]))


def _back(pose: AgentPose, offset: Floats) -> AgentPose:
    return pose.model_copy(update={"pose": _without(pose.pose, offset)})


def _moved(chunk: Chunk, offset: Floats) -> Chunk:
    """Returns a placed chunk as its sensor's corrected pose has it."""
    if chunk.placed is None:
        return chunk
    sensor_m = chunk.sensor_pose[:3]
    turn = euler_rotation(0.0, 0.0, -offset[3])
    shift = sensor_m - offset[:3] - turn @ sensor_m
    lowest = chunk.placed.lowest.copy()
    lowest[:, :2] = lowest[:, :2] @ turn[:2, :2].T + shift[:2]
    lowest[:, 2] -= offset[2]
    motion = np.column_stack([turn[:2, :2], shift[:2]]).astype(np.float32)
    points = _turned(chunk.placed.points, motion, np.float32(shift[2]))
    placed = Placed(points, chunk.placed.road_m, lowest)
    return replace(chunk, placed=placed, sensor_pose=_without(chunk.sensor_pose, offset))


@njit("float32[:,::1](float32[:,::1], float32[:,::1], float32)", cache=True, nogil=True)
def _turned(points: Floats32, motion: Floats32, up_m: float) -> Floats32:
    """Moves points (N, 3) by a motion (2, 3) in the plane, and up."""
    moved = np.empty_like(points)
    for index in range(points.shape[0]):
        x, y = points[index, 0], points[index, 1]
        moved[index, 0] = motion[0, 0] * x + motion[0, 1] * y + motion[0, 2]
        moved[index, 1] = motion[1, 0] * x + motion[1, 1] * y + motion[1, 2]
        moved[index, 2] = points[index, 2] + up_m
    return moved


def _published(agent: str, known: _Known, fit: Fit) -> AgentAlignment:
    x_m, y_m, z_m, yaw_rad = known.filter.offset.tolist()
    return AgentAlignment(
        agent=agent,
        x_m=round(x_m, 3),
        y_m=round(y_m, 3),
        z_m=round(z_m, 3),
        yaw_rad=round(yaw_rad, 5),
        std_m=round(float(known.filter.std[:2].max()), 3),
        points=fit.known,
        inliers=round(fit.inliers, 3),
        excluded=known.is_excluded,
    )
