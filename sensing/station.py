"""What every agent process shares: the clock it hears, the LiDAR it casts, what it reports."""

from __future__ import annotations

from collections import Counter

from protocol.bus import Bus
from protocol.inbox import Envelope, Presence
from protocol.messages import End, Metrics, Roster, Span, Tick, Upload
from protocol.process import Context
from sensing.config import LidarConfig, SceneConfig, UploadConfig
from sensing.lidar import Lidar
from sensing.link.config import LinkConfig
from sensing.radio import AgentKind, Radio, radio_of
from sensing.scene import scene_of
from sensing.shapes import VehicleShapes
from sensing.uplink import Uplink


class Station:
    """Keeps the newest tick: an agent that is late goes on with the present, not with the past."""

    def __init__(self, context: Context, kind: AgentKind) -> None:
        scenario = context.setup.scenario
        self.context = context
        self.seed: int = scenario["seed"]
        self.region: str = scenario["region"]
        self.link = LinkConfig.of(scenario)
        self._kind: AgentKind = kind
        config = LidarConfig.model_validate(scenario["lidar"][kind])
        scene = scene_of(context.setup, SceneConfig.model_validate(scenario["scene"]), self.seed)
        self.terrain = scene.terrain
        self._lidar = Lidar(config, scene, VehicleShapes.from_setup(context.setup))
        self._upload = UploadConfig.model_validate(scenario["upload"])
        self._tick: Tick | None = None
        self._drops: Counter[str] = Counter()

    def open(self, role: str) -> None:
        """Listens to the world and shows that the process is ready."""
        self.context.world.subscribe("tick")
        self.context.world.subscribe("end")
        self.context.announce(role)

    def radio(self, agent: str, bus: Bus) -> Radio:
        """Returns the radio of an agent with this connection."""
        return radio_of(self.context.setup.scenario, self.link, self._kind, agent, bus)

    def uplink(self, agent: str, bus: Bus, radio: Radio) -> Uplink:
        """Returns the way to the edge of one agent that has this bus for itself."""
        return Uplink(agent, self.region, bus, radio, self._lidar, self._upload, self.seed)

    def note_skipped_scans(self, number: int) -> None:
        """Counts scans that were left out because the link had not taken the last one yet."""
        self._drops["skipped_scans"] += number

    def take(self, item: Envelope | Presence) -> None:
        """Looks at what arrived; all but ticks and the end are let pass."""
        if not isinstance(item, Envelope):
            return
        if isinstance(item.message, Tick):
            self._drops["skipped_ticks"] += self._tick is not None
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

    def publish_metrics(self, tick: Tick, uploads: list[Upload], spans: list[Span]) -> None:
        """Accounts for a frame."""
        metrics = Metrics(
            process=self.context.id,
            frame=tick.frame,
            sim_time_ns=tick.sim_time_ns,
            spans=spans,
            uploads=uploads,
            points=sum(upload.points for upload in uploads),
            drops=dict(+(Counter(self.context.inbox.drops) + self._drops)),
        )
        self.context.world.publish("metrics", metrics, process=self.context.id)
