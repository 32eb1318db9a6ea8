"""What every agent process shares: the clock it hears, the LiDAR it casts, what it reports."""

from __future__ import annotations

from protocol.bus import Bus
from protocol.inbox import Envelope, Presence
from protocol.messages import End, Metrics, Roster, Span, Tick, Upload, WireCount
from protocol.process import Context
from sensing.config import LidarConfig, SceneConfig, UploadConfig
from sensing.lidar import Lidar
from sensing.scene import scene_of
from sensing.shapes import VehicleShapes
from sensing.uplink import Uplink


class Station:
    """Keeps the newest tick: an agent that is late goes on with the present, not with the past."""

    def __init__(self, context: Context, lidar: str) -> None:
        scenario = context.setup.scenario
        self.context = context
        self.seed: int = scenario["seed"]
        self.region: str = scenario["region"]
        config = LidarConfig.model_validate(scenario["lidar"][lidar])
        scene = scene_of(context.setup, SceneConfig.model_validate(scenario["scene"]), self.seed)
        self.terrain = scene.terrain
        self._lidar = Lidar(config, scene, VehicleShapes.from_setup(context.setup))
        self._upload = UploadConfig.model_validate(scenario["upload"])
        self._tick: Tick | None = None
        self._skipped = 0

    def open(self, role: str) -> None:
        """Listens to the world and shows that the process is ready."""
        self.context.world.subscribe("tick")
        self.context.world.subscribe("end")
        self.context.announce(role)

    def uplink(self, agent: str, bus: Bus) -> Uplink:
        """Returns the way to the edge of one agent that has this bus for itself."""
        return Uplink(agent, self.region, bus, self._lidar, self._upload, self.seed)

    def take(self, item: Envelope | Presence) -> None:
        """Looks at what arrived; all but ticks and the end are let pass."""
        if not isinstance(item, Envelope):
            return
        if isinstance(item.message, Tick):
            self._skipped += self._tick is not None
            self._tick = item.message
        elif isinstance(item.message, End):
            self.context.stop.set()

    def pop(self) -> Tick | None:
        """Returns the tick to work on, once."""
        tick, self._tick = self._tick, None
        return tick

    def publish_roster(self, tick: Tick, agents: list[str], scanning: list[str]) -> None:
        """Says, before anything is sent, whose poses and scans the edge may expect."""
        process = self.context.id
        roster = Roster(frame=tick.frame, process=process, agents=agents, scanning=scanning)
        self.context.v2x.publish("roster", roster, region=self.region, process=process)

    def publish_metrics(
        self, tick: Tick, uploads: list[Upload], spans: list[Span], wire: list[WireCount]
    ) -> None:
        """Accounts for a frame."""
        drops = dict(self.context.inbox.drops)
        if self._skipped:
            drops["skipped_ticks"] = self._skipped
        metrics = Metrics(
            process=self.context.id,
            frame=tick.frame,
            sim_time_ns=tick.sim_time_ns,
            spans=spans,
            uploads=uploads,
            wire=wire,
            points=sum(upload.points for upload in uploads),
            drops=drops,
        )
        self.context.world.publish("metrics", metrics, process=self.context.id)
