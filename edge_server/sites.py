"""Where the agents' sensors stand, from whatever told it last, be it late for its frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from perception.arrays import Floats
from protocol.messages import AgentPose, Scan

MAX_AGENTS = 512
FORGET_FRAMES = 10


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """A sensor's place (2,) in m in the map frame, in a frame; `drives` if it has said a pose."""

    frame: int
    place: Floats
    drives: bool


class Sites:
    """Remembers one place per agent. Posts say no pose, only scans tell where they stand."""

    def __init__(self) -> None:
        self._sites: dict[str, Site] = {}

    def hear(self, message: AgentPose | Scan) -> None:
        """Takes note of where an agent believes to be; of too many agents no more are noted."""
        known = self._sites.get(message.agent)
        says_pose = isinstance(message, AgentPose)
        if known is None and len(self._sites) >= MAX_AGENTS:
            return
        if known is not None and message.frame < known.frame:
            return
        drives = says_pose or (known is not None and known.drives)
        place = message.pose if isinstance(message, AgentPose) else message.sensor_pose
        self._sites[message.agent] = Site(message.frame, place[:2], drives)

    def of(self, agents: Sequence[str], frame: int) -> dict[str, Site]:
        """Returns the sites of those agents that are known; who fell silent is forgotten."""
        silent = [a for a, site in self._sites.items() if site.frame < frame - FORGET_FRAMES]
        for agent in silent:
            del self._sites[agent]
        return {agent: self._sites[agent] for agent in agents if agent in self._sites}
