"""The LiDARs of an agent process, and what is done with their scans before they are sent."""

from __future__ import annotations

from perception.roadway import Roadway
from protocol.bus import Bus
from protocol.process import Context
from sensing.config import LidarConfig, SceneConfig, UploadConfig
from sensing.radio import AgentKind, Radio
from sensing.source import source_of
from sensing.terrain import Terrain
from sensing.uplink import Kit, Uplink
from sensing.upload.chooser import chooser_of
from sensing.upload.objects import OnBoard
from sensing.upload.registry import policy_of
from sensing.upload.selection import Selector


class Sensors:
    """Makes the uplink of each agent of one kind that has a LiDAR."""

    def __init__(self, context: Context, kind: AgentKind) -> None:
        scenario, road_map = context.setup.scenario, context.setup.road_map
        config = LidarConfig.model_validate(scenario["lidar"][kind])
        scene = SceneConfig.model_validate(scenario["scene"])
        upload = UploadConfig.model_validate(scenario["upload"])
        self.terrain = Terrain(road_map, scene, scenario["seed"])
        self._pattern = config.pattern
        self._standing = kind == "roadside"
        self._chosen = upload.of(kind)
        self._policy = policy_of(self._chosen.policy)
        self._roadway = Roadway.of(road_map, margin_m=upload.roi_margin_m)
        detects = self._policy.sends == "objects"
        self._kit = Kit(
            region=scenario["region"],
            process=context.id,
            seed=scenario["seed"],
            source=source_of(context.setup, config),
            config=upload,
            detector=OnBoard.of(road_map, scenario["edge"]) if detects else None,
            lockstep=scenario["mode"] == "lockstep",
            period_ns=round(scenario["frame_period_s"] * 1e9),
        )

    def uplink(self, agent: str, bus: Bus, radio: Radio) -> Uplink:
        """Returns the way to the edge of an agent that has this bus for itself."""
        selector = Selector(
            self._policy,
            self._chosen.filters,
            self._roadway,
            self._pattern,
            chooser_of(self._chosen.policy, self._kit.config, self._roadway, self._pattern),
            thin_m=self._kit.config.thin_m,
            standing=self._standing,
        )
        return Uplink(agent, bus, radio, self._kit, selector)
