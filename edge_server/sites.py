"""Where the agents' sensors stand, from whatever told it last, be it late for its frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from perception.arrays import Floats
from protocol.messages import AgentPose, Scan

MAX_AGENTS = 512
FORGET_FRAMES = 10


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """A sensor's place (2,) in m in the map frame; `drives` if its agent has said a pose.

    `told` are the frame and whether a scan said it: the newest is believed, and of one frame a scan
    rather than a pose, which is that of the vehicle below the sensor. So the order in which they
    come is no matter.
    """

    told: tuple[int, bool]
    place: Floats
    drives: bool


class Sites:
    """Remembers one place per agent. Posts say no pose, only scans tell where they stand."""

    def __init__(self) -> None:
        self._sites: dict[str, Site] = {}

    def hear(self, message: AgentPose | Scan) -> None:
        """Takes note of where an agent believes to be; of too many agents no more are noted."""
        known = self._sites.get(message.agent)
        if known is None and len(self._sites) >= MAX_AGENTS:
            return
        if isinstance(message, AgentPose):
            site = Site((message.frame, False), message.pose[:2], drives=True)
        else:
            drives = known is not None and known.drives
            site = Site((message.frame, True), message.sensor_pose[:2], drives)
        if known is not None and known.told > site.told:
            site = replace(known, drives=known.drives or site.drives)
        self._sites[message.agent] = site

    def of(self, agents: Sequence[str], frame: int) -> dict[str, Site]:
        """Returns the sites of those agents that are known; who fell silent is forgotten."""
        silent = [a for a, site in self._sites.items() if site.told[0] < frame - FORGET_FRAMES]
        for agent in silent:
            del self._sites[agent]
        return {agent: self._sites[agent] for agent in agents if agent in self._sites}
