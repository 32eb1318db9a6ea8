"""Upload plans: frame by frame, from sensor sites and estimated uplink rates."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from edge_server.completion import CellBorders, UploadProgress, uploaded
from edge_server.config import PlanConfig
from edge_server.frame import Frame
from edge_server.power_diagram import (
    PLAIN,
    TIGHT,
    WIDE,
    cells,
    partners,
    power_weights,
    voronoi_weights,
)
from perception.arrays import Floats
from protocol.messages import NEVER_NS, AgentPose, Plan, Scan
from protocol.roadmap import RoadMap
from sensing.config import UploadConfig
from sensing.limits import MAX_AGE_FRAMES
from sensing.link_config import LinkConfig
from sensing.radio import ENVELOPE_BYTES
from sensing.upload_policies import Policy, policy_of

MAX_UPLINKS = 512
HALF_LIFE_FRAMES = 3
FORGET_UPLINK_FRAMES = 100
LEAST_MBPS, MOST_MBPS = 0.1, 1000.0
SMALL_BYTES = 1500  # a packet: its time is the delay, that of larger ones the rate
SMALL_KEPT = 50
_LONGEST_NS = 10_000_000_000  # between sending and arrival; more, or less than 0: different clocks


@dataclass(slots=True)
class _History:
    """One agent's exponentially aged sums and the delays of its last small messages."""

    frame: int
    size_bytes: float = 0.0
    busy_ns: float = 0.0
    arrived_ns: int = 0
    arrived_frame: int = -1
    delays_ns: deque[int] = field(default_factory=lambda: deque(maxlen=SMALL_KEPT))


class Bandwidth:
    """Estimates each agent's uplink rate from the arrival of its chunks at the edge.

    An uplink is busy with a chunk from when the chunk was sent, or from when the one before it had
    arrived if that is later, until it has arrived. The rate is the sum of bytes over the sum of
    busy time, both aged, so that one late wake-up of either side does not count more than it took.
    The least time that a small message ever took is no time of transmission and is subtracted.

    Both stamps of a chunk must be of one clock: the same machine's, or aligned by the caller. Where
    they plainly are not, chunks that arrive one after the other still yield the rate.
    """

    def __init__(self) -> None:
        self._histories: dict[str, _History] = {}

    def add(
        self, agent: str, frame: int, size_bytes: int, *, sent_ns: int, received_ns: int
    ) -> None:
        """Adds a chunk, late or not; agents beyond `MAX_UPLINKS` are not kept."""
        history = self._histories.get(agent)
        if history is None:
            if len(self._histories) >= MAX_UPLINKS:
                return
            history = self._histories[agent] = _History(frame)
        self._age(history, frame)
        busy_ns = _busy_ns(history, frame, size_bytes, sent_ns, received_ns)
        history.arrived_ns = max(history.arrived_ns, received_ns)
        history.arrived_frame = frame
        if busy_ns is not None:
            history.size_bytes += size_bytes
            history.busy_ns += busy_ns

    def mbps(self, agent: str) -> float | None:
        """Returns the estimate, from 0.1 to 1000 Mbit/s; None while it is unknown."""
        history = self._histories.get(agent)
        if history is None or history.size_bytes == 0:
            return None
        rate = history.size_bytes * 8e3 / max(history.busy_ns, 1.0)
        return min(max(rate, LEAST_MBPS), MOST_MBPS)

    def forget(self, frame: int) -> None:
        """Forgets agents from which nothing arrived for long before this frame."""
        for agent in [
            a for a, h in self._histories.items() if h.frame < frame - FORGET_UPLINK_FRAMES
        ]:
            del self._histories[agent]

    @staticmethod
    def _age(history: _History, frame: int) -> None:
        passed = max(frame - history.frame, 0)
        fading = 0.5 ** (passed / HALF_LIFE_FRAMES)
        history.size_bytes *= fading
        history.busy_ns *= fading
        history.frame = max(frame, history.frame)


def _busy_ns(
    history: _History, frame: int, size_bytes: int, sent_ns: int, received_ns: int
) -> int | None:
    """Returns how long the uplink was busy with a chunk; None if that is unknown."""
    if not 0 <= received_ns - sent_ns <= _LONGEST_NS:
        follows = history.arrived_frame == frame and history.arrived_ns > 0
        return max(received_ns - history.arrived_ns, 0) if follows else None
    is_small = size_bytes <= SMALL_BYTES
    if is_small:
        history.delays_ns.append(received_ns - sent_ns)
    begin_ns = sent_ns + min(history.delays_ns, default=0)
    queued = history.arrived_ns > begin_ns
    if is_small and not queued:
        return None
    return max(received_ns - max(begin_ns, history.arrived_ns), 0)


MAX_SITES = 512
SITE_AGE_FRAMES = 10


@dataclass(frozen=True, slots=True, eq=False)
class SensorSite:
    """A sensor's place (2,) in m in the map frame; `drives` if its agent has published a pose.

    `source` are the frame and whether it was a scan's: the newest wins, and of one frame a scan
    over a pose, which is that of the vehicle below the sensor. So the order of arrival does not
    matter.
    """

    source: tuple[int, bool]
    place: Floats
    drives: bool


class SensorSites:
    """Remembers one place per agent. Roadside units publish no pose, only scans."""

    def __init__(self) -> None:
        self._sites: dict[str, SensorSite] = {}

    def add(self, message: AgentPose | Scan) -> None:
        """Adds an agent's claimed position; agents beyond `MAX_SITES` are not kept."""
        known = self._sites.get(message.agent)
        if known is None and len(self._sites) >= MAX_SITES:
            return
        if isinstance(message, AgentPose):
            site = SensorSite((message.frame, False), message.pose[:2], drives=True)
        else:
            drives = known is not None and known.drives
            site = SensorSite((message.frame, True), message.sensor_pose[:2], drives)
        if known is not None and known.source > site.source:
            site = replace(known, drives=known.drives or site.drives)
        self._sites[message.agent] = site

    def of(self, agents: Sequence[str], frame: int) -> dict[str, SensorSite]:
        """Returns the known sites of these agents; forgets agents that stopped sending."""
        silent = [a for a, site in self._sites.items() if site.source[0] < frame - SITE_AGE_FRAMES]
        for agent in silent:
            del self._sites[agent]
        return {agent: self._sites[agent] for agent in agents if agent in self._sites}


AHEAD_FRAMES = 2  # a plan is followed so long after its frame: by then all agents have it
KEPT_PLANS = MAX_AGE_FRAMES + AHEAD_FRAMES + 1  # no agent follows an older one
_NOWHERE = np.zeros((0, 2)), np.zeros((0, 3))
_BEYOND_M = 600.0  # around the lanes: farther than any sensor on the road sees


@dataclass(slots=True, eq=False)
class Partition:
    """The cells of a plan, computed as they are asked for, by border."""

    agents: list[str]
    sites: Floats
    weights_m2: Floats
    _cells: dict[int, list[Floats]] = field(default_factory=dict)

    def cell(self, agent: str, border: int, box: Floats) -> Floats:
        """Returns an agent's cell (V, 2) within a box; an agent that it did not know has none."""
        if agent not in self.agents or border < TIGHT:
            return _NOWHERE[0]
        if border not in self._cells:
            self._cells[border] = cells(self.sites, self.weights_m2, box, border=border)
        return self._cells[border][self.agents.index(agent)]


class Planner:
    """Makes upload plans frame by frame. In lockstep, nothing that a clock measured enters a plan.

    There, uplink rates are known on virtual links alone, in simulated time.
    """

    def __init__(self, scenario: dict[str, Any], config: PlanConfig, road_map: RoadMap) -> None:
        upload = UploadConfig.model_validate(scenario.get("upload", {}))
        self._vehicle, self._roadside = (
            policy_of(upload.of(kind).policy) for kind in ("vehicle", "roadside")
        )
        self._config = config
        self._lockstep = scenario["mode"] == "lockstep"
        link = LinkConfig.of(scenario)
        self._is_virtual = link.channel(scenario["mode"]) == "virtual"
        self._lead_ns = round(link.agent_compute_ms * 1e6)
        self._box = _box(road_map)
        self._borders: dict[int, CellBorders] = {}
        self._partitions: dict[int, Partition] = {}
        self.sites = SensorSites()
        self.bandwidth = Bandwidth()

    @property
    def ends_early(self) -> bool:
        """Whether frames may end before all chunks arrived: these take time and arrive in order."""
        both = (self._vehicle, self._roadside)
        in_order = any(policy.cells and policy.chunks > 1 for policy in both)
        return in_order and self._config.early_end and (self._is_virtual or not self._lockstep)

    def plans(self, frame: Frame, enough_sim_ns: int | None = None) -> list[Plan]:
        """Returns the plans, from `AHEAD_FRAMES` later on, of all agents that scanned in a frame.

        In lockstep these are the agents with cells alone, since the others need no plan. Over
        virtual links the edge has had enough of the frame since `enough_sim_ns`.
        """
        if self._is_virtual:
            self._add_virtual(frame)
        self.bandwidth.forget(frame.frame)
        known = self.sites.of(frame.scanning, frame.frame)
        sites = {agent: site for agent, site in known.items() if self._policy(site).cells}
        agents = sorted(sites)
        # To the centimetre: two agents stand at one place or truly apart, which no rounding blurs.
        places = np.round(np.array([sites[agent].place for agent in agents]).reshape(-1, 2), 2)
        weights_m2 = self._weights_m2(agents, places)
        first = frame.frame + AHEAD_FRAMES
        self._remember(first, agents, places, weights_m2)
        plans = []
        for agent in frame.scanning:
            planned = agent in sites
            if planned or not self._lockstep:
                site_array, weight_array = (places, weights_m2) if planned else _NOWHERE
                plans.append(
                    Plan(
                        frame=first,
                        agent=agent,
                        mbps=self.bandwidth.mbps(agent) or 0.0,
                        enough=frame.frame,
                        enough_sim_ns=enough_sim_ns,
                        agents=agents if planned else [],
                        sites=site_array,
                        weights_m2=weight_array,
                    )
                )
        return plans

    def covers(self, uploaded: Mapping[str, UploadProgress]) -> bool:
        """Whether the chunks that arrived are enough for a frame.

        That is so if it holds by any plan that one of them followed.
        """
        plans = {scan.plan_frame for scan in uploaded.values()} & self._borders.keys()
        return any(self._covers_by(plan, uploaded) for plan in plans)

    def _covers_by(self, plan: int, uploaded: Mapping[str, UploadProgress]) -> bool:
        """Decides by one plan; an agent that followed another counts once its whole scan arrived.

        Of newcomers that the plan did not know, nothing is needed; of agents that have no cells,
        all is.
        """
        borders = self._borders[plan]
        cut = {a: scan.came_by(plan) for a, scan in uploaded.items() if a in borders.agents}
        others = [scan for agent, scan in uploaded.items() if agent not in borders.agents]
        both_have_cells = self._vehicle.cells and self._roadside.cells
        return borders.covered(cut) and (both_have_cells or all(scan.is_whole for scan in others))

    def cells_of(self, frame: Frame) -> dict[str, Floats]:
        """Returns, by agent, the part of the scene (V, 2) that its chunks of a frame are of.

        A convex polygon in CCW order, empty if it is of none or by a plan that is forgotten. Agents
        that sent all that they see are left out.
        """
        found: dict[str, Floats] = {}
        decoded = replace(frame, chunks=[one for one in frame.chunks if not one.is_undecodable])
        came = {agent: scan.came for agent, scan in uploaded(decoded).items()}
        for one in frame.chunks:
            number = came.get(one.agent, 0)
            is_whole = number > WIDE + 1 or 1 < one.chunk_count == number
            if one.plan_frame >= 0 and not is_whole and one.agent not in found:
                partition = self._partitions.get(one.plan_frame, Partition([], *_NOWHERE))
                border = PLAIN if one.chunk_count == number == 1 else number - 1
                found[one.agent] = partition.cell(one.agent, border, self._box)
        return found

    def _add_virtual(self, frame: Frame) -> None:
        """Adds, by agent, how long the chunks of a frame were on their virtual links."""
        sent_ns = frame.sim_time_ns + self._lead_ns
        came = [(pose.agent, -1, 0, pose.arrival_sim_ns) for pose in frame.poses]
        came += [(p.agent, p.index, p.size_bytes, p.arrival_sim_ns) for p in frame.chunks]
        for agent, _, payload_bytes, arrival_ns in sorted(came, key=lambda part: part[:2]):
            if arrival_ns is not None and arrival_ns < NEVER_NS:
                size_bytes = payload_bytes + ENVELOPE_BYTES
                self.bandwidth.add(
                    agent, frame.frame, size_bytes, sent_ns=sent_ns, received_ns=arrival_ns
                )

    def _policy(self, site: SensorSite) -> Policy:
        return self._vehicle if site.drives else self._roadside

    def _weights_m2(self, agents: list[str], places: Floats) -> Floats:
        if not (self._vehicle.weighted or self._roadside.weighted):
            return voronoi_weights(places)
        nominal = self._config.nominal_mbps
        mbps = [self.bandwidth.mbps(agent) or nominal for agent in agents]
        return power_weights(places, np.array(mbps, np.float64), alpha=self._config.alpha)

    def _remember(self, frame: int, agents: list[str], places: Floats, weights_m2: Floats) -> None:
        if agents:
            self._partitions[frame] = Partition(agents, places, weights_m2)
        if self.ends_early:
            self._borders[frame] = borders_of(agents, places, weights_m2, self._box)
        for kept in (self._partitions, self._borders):
            while len(kept) > KEPT_PLANS:
                del kept[min(kept)]


def borders_of(agents: list[str], sites: Floats, weights_m2: Floats, box: Floats) -> CellBorders:
    """Returns the cell borders of a plan: which agents are neighbours."""
    plain = cells(sites, weights_m2, box, border=PLAIN)
    owners = tuple(agent for agent, cell in zip(agents, plain, strict=True) if len(cell))
    pairs = partners(sites, weights_m2, box)
    return CellBorders(tuple(agents), owners, tuple((agents[i], agents[j]) for i, j in pairs))


def _box(road_map: RoadMap) -> Floats:
    places = np.concatenate([lane.points[:, :2] for lane in road_map.lanes])
    return np.concatenate([places.min(axis=0) - _BEYOND_M, places.max(axis=0) + _BEYOND_M])
