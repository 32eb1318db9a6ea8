"""Makes each frame's plan from where the agents stand and what their uplinks carry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from edge_server.bandwidth import Bandwidth
from edge_server.config import PlanConfig
from edge_server.coverage import Borders, Uploaded
from edge_server.frame import Frame
from edge_server.plan import PLAIN, cells, partners, power_weights, voronoi_weights
from edge_server.sites import Site, Sites
from perception.arrays import Floats
from protocol.messages import NEVER_NS, Plan
from protocol.roadmap import RoadMap
from sensing.config import UploadConfig
from sensing.link_config import LinkConfig
from sensing.radio import ENVELOPE_BYTES
from sensing.upload_policies import Policy, policy_of

AHEAD_FRAMES = 2  # a plan is followed so long after its frame: by then all agents have it
KEPT_PLANS = 8
_BEYOND_M = 600.0  # around the lanes: farther than any sensor on the road sees


class Planner:
    """Plans frame by frame. In lockstep, nothing that a clock measured enters a plan.

    What an uplink carries shows there on virtual links alone, in simulated time.
    """

    def __init__(self, scenario: dict[str, Any], config: PlanConfig, road_map: RoadMap) -> None:
        upload = UploadConfig.model_validate(scenario.get("upload", {}))
        self._vehicle, self._roadside = (
            policy_of(upload.of(kind).policy) for kind in ("vehicle", "roadside")
        )
        self._config = config
        self._lockstep = scenario["mode"] == "lockstep"
        link = LinkConfig.of(scenario)
        self._is_virtual = link.way(scenario["mode"]) == "virtual"
        self._lead_ns = round(link.agent_compute_ms * 1e6)
        self._box = _box(road_map)
        self._borders: dict[int, Borders] = {}
        self.sites = Sites()
        self.bandwidth = Bandwidth()

    @property
    def ends_early(self) -> bool:
        """Whether frames may end before all chunks came: they take time and come in an order."""
        both = (self._vehicle, self._roadside)
        in_order = any(policy.cells and policy.chunks > 1 for policy in both)
        return in_order and self._config.early_end and (self._is_virtual or not self._lockstep)

    def plans(self, frame: Frame, enough_sim_ns: int | None = None) -> list[Plan]:
        """Returns what every agent that scanned in a frame shall send from `AHEAD_FRAMES` later on.

        In lockstep these are the agents with cells alone, since the others need no plan. Over
        virtual links the edge has had enough of the frame since `enough_sim_ns`.
        """
        if self._is_virtual:
            self._hear_virtual(frame)
        self.bandwidth.forget(frame.frame)
        known = self.sites.of(frame.scanning, frame.frame)
        sites = {agent: site for agent, site in known.items() if self._policy(site).cells}
        agents = sorted(sites)
        # To the centimetre: two agents stand at one place or truly apart, which no rounding blurs.
        places = np.round(np.array([sites[agent].place for agent in agents]).reshape(-1, 2), 2)
        weights_m2 = self._weights_m2(agents, places)
        first = frame.frame + AHEAD_FRAMES
        self._remember(first, agents, places, weights_m2)
        nowhere = np.zeros((0, 2)), np.zeros((0, 3))
        plans = []
        for agent in frame.scanning:
            planned = agent in sites
            if planned or not self._lockstep:
                site_array, weight_array = (places, weights_m2) if planned else nowhere
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

    def covers(self, uploaded: Mapping[str, Uploaded]) -> bool:
        """Whether a frame needs no more of its scanning agents than what they have sent.

        That is so if it holds by any plan that one of them followed.
        """
        plans = {scan.plan_frame for scan in uploaded.values()} & self._borders.keys()
        return any(self._covers_by(plan, uploaded) for plan in plans)

    def _covers_by(self, plan: int, uploaded: Mapping[str, Uploaded]) -> bool:
        """Judges by one plan; who followed another counts once all came that it sees.

        Of newcomers that the plan did not know, nothing is needed; of agents that have no cells,
        all is.
        """
        borders = self._borders[plan]
        cut = {a: scan.came_by(plan) for a, scan in uploaded.items() if a in borders.agents}
        others = [scan for agent, scan in uploaded.items() if agent not in borders.agents]
        both_have_cells = self._vehicle.cells and self._roadside.cells
        return borders.covered(cut) and (both_have_cells or all(scan.is_whole for scan in others))

    def _hear_virtual(self, frame: Frame) -> None:
        """Takes note, agent by agent, of how long what came of a frame was on its virtual link."""
        sent_ns = frame.sim_time_ns + self._lead_ns
        came = [(pose.agent, -1, 0, pose.arrival_sim_ns) for pose in frame.poses]
        came += [(p.agent, p.index, p.size_bytes, p.arrival_sim_ns) for p in frame.pieces]
        for agent, _, payload_bytes, arrival_ns in sorted(came, key=lambda part: part[:2]):
            if arrival_ns is not None and arrival_ns < NEVER_NS:
                size_bytes = payload_bytes + ENVELOPE_BYTES
                self.bandwidth.heard(
                    agent, frame.frame, size_bytes, sent_ns=sent_ns, received_ns=arrival_ns
                )

    def _policy(self, site: Site) -> Policy:
        return self._vehicle if site.drives else self._roadside

    def _weights_m2(self, agents: list[str], places: Floats) -> Floats:
        if not (self._vehicle.weighted or self._roadside.weighted):
            return voronoi_weights(places)
        nominal = self._config.nominal_mbps
        mbps = [self.bandwidth.mbps(agent) or nominal for agent in agents]
        return power_weights(places, np.array(mbps, np.float64), alpha=self._config.alpha)

    def _remember(self, frame: int, agents: list[str], places: Floats, weights_m2: Floats) -> None:
        if self.ends_early:
            self._borders[frame] = borders_of(agents, places, weights_m2, self._box)
            while len(self._borders) > KEPT_PLANS:
                del self._borders[min(self._borders)]


def borders_of(agents: list[str], sites: Floats, weights_m2: Floats, box: Floats) -> Borders:
    """Returns who borders on whom in a plan."""
    plain = cells(sites, weights_m2, box, border=PLAIN)
    owners = tuple(agent for agent, cell in zip(agents, plain, strict=True) if len(cell))
    pairs = partners(sites, weights_m2, box)
    return Borders(tuple(agents), owners, tuple((agents[i], agents[j]) for i, j in pairs))


def _box(road_map: RoadMap) -> Floats:
    places = np.concatenate([lane.points[:, :2] for lane in road_map.lanes])
    return np.concatenate([places.min(axis=0) - _BEYOND_M, places.max(axis=0) + _BEYOND_M])
