"""An agent process's station: it follows ticks and plans, and reports on its agents' uplinks."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import TypeVar

import numpy as np

from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.inbox import Envelope, Presence
from protocol.limits import MAX_LENGTH_M
from protocol.messages import (
    End,
    Metrics,
    Plan,
    Roster,
    Sighting,
    Span,
    Tick,
    TileBodies,
    Upload,
    WireCount,
)
from protocol.process import Context
from protocol.topics import TOPICS
from protocol.traffic import framed_bytes
from sensing.config import LidarConfig, UploadConfig
from sensing.lidar import Sensed
from sensing.link_config import LinkConfig
from sensing.radio import AgentKind, Radio, radio_of
from sensing.uplink import FrameUpload, Uplink
from sensing.upload_policies import policy_of
from sensing.world_view import Surroundings, WorldView

U = TypeVar("U", bound=Uplink)

PLAN_WAIT_NS = 2_000_000_000  # in lockstep; a plan that has not come by then is lost


class Station:
    """Ticks, plans and uplinks of an agent process; a late agent continues with the newest tick.

    In lockstep, an agent that scanned in one frame waits in the next for the plan that the edge
    made of it: the same plan is followed however long its message took.
    """

    def __init__(
        self, context: Context, kind: AgentKind, region: str = "", *, sees_bodies: bool = True
    ) -> None:
        """Serves one region, or all of the scenario; with a recording it needs no bodies."""
        scenario = context.setup.scenario
        self.context = context
        self.seed: int = scenario["seed"]
        self.regions: tuple[str, ...] = (region,) if region else tuple(scenario["regions"])
        self.link = LinkConfig.of(scenario)
        self._kind: AgentKind = kind
        self._keeps_truth: bool = scenario["record"]["truth"]
        self._policy = policy_of(UploadConfig.model_validate(scenario["upload"]).of(kind).policy)
        self._lockstep = scenario["mode"] == "lockstep"
        self._uplinks: dict[str, Uplink] = {}
        self._scanned: tuple[int, list[str]] = (-1, [])
        self._settled: list[WireCount] = []
        self._left: list[FrameUpload] = []
        reach_m = LidarConfig.model_validate(scenario["lidar"][kind]).range + MAX_LENGTH_M / 2
        self._surroundings = (
            Surroundings(context.world, context.id, reach_m) if sees_bodies else None
        )
        self._tick: Tick | None = None
        self._ticked_ns = 0
        self._drops: Counter[str] = Counter()

    @property
    def uploads(self) -> bool:
        """Whether the upload policy sends more than poses."""
        return self._policy.sends != "nothing"

    def open(self, role: str) -> None:
        """Subscribes to ticks and the end, and announces that the process is ready."""
        self.context.world.subscribe("tick")
        self.context.world.subscribe("end")
        self.context.announce(role)

    def stand_at(self, places: Floats) -> None:
        """Follows the bodies around stationary sensors at x, y (N, 2), map frame, in m."""
        if self._surroundings is not None:
            self._surroundings.stand_at(places)

    def radio(self, agent: str, bus: Bus) -> Radio:
        """Returns the radio of an agent with this connection."""
        return radio_of(self.context.setup.scenario, self.link, self._kind, agent, bus)

    def add(self, uplink: U) -> U:
        """Adds an agent's uplink, with its own connection, and subscribes to the edges' plans."""
        if self._policy.cells or not self._lockstep:
            uplink.bus.subscribe("plan", agent=uplink.agent)
        self._uplinks[uplink.agent] = uplink
        return uplink

    def close_uplink(self, agent: str) -> None:
        """Ends an agent's uplink; the caller closes its connection."""
        uplink = self._uplinks.pop(agent)
        uplink.finish()
        self._left += uplink.take_done()
        self._settled += uplink.take_wire_counts()
        self._drops["overtaken_chunks"] += uplink.unsent_chunks

    def begin(self, view: WorldView) -> None:
        """Begins a frame on all uplinks."""
        for _, uplink in sorted(self._uplinks.items()):
            uplink.begin(view.frame, view.sim_time_ns)
            self._settled += uplink.take_wire_counts(view.frame)

    def admits(self, radio: Radio, view: WorldView) -> bool:
        """Whether an agent takes part in a frame; not while its link is congested."""
        congested = radio.is_congested(view.sim_time_ns)
        self._drops["skipped_frames"] += congested
        return not congested

    def take(self, item: Envelope | Presence) -> None:
        """Handles ticks, tile bodies, plans and the end; ignores everything else."""
        if not isinstance(item, Envelope):
            return
        if isinstance(item.message, Tick):
            self._drops["skipped_ticks"] += self._tick is not None
            self._tick, self._ticked_ns = item.message, item.received_ns
            if self._surroundings is not None:
                self._surroundings.begin(item.message)
        elif isinstance(item.message, TileBodies) and self._surroundings is not None:
            self._surroundings.take(item.message)
        elif isinstance(item.message, Plan):
            if uplink := self._uplinks.get(item.message.agent):
                uplink.receive(item.message, item.parts["region"])
        elif isinstance(item.message, End):
            self.context.stop.set()

    def pop(self) -> WorldView | None:
        """Returns a frame once, as soon as its bodies and the plans for it have arrived."""
        tick, around = self._tick, self._surroundings
        if tick is None or (around is not None and not around.is_complete()):
            return None
        if self._awaits_plan(tick):
            return None
        self._tick = None
        return WorldView.without_bodies(tick) if around is None else around.view(tick)

    def publish_rosters(
        self, view: WorldView, members: Mapping[str, Sequence[str]], scanning: Collection[str]
    ) -> None:
        """Publishes rosters, before anything is sent: whose poses and scans each edge can expect.

        Args:
            view: begins the frame.
            members: the regions of each agent that takes part.
            scanning: the agents of them that send a scan.
        """
        process = self.context.id
        for region in self.regions:
            agents = [agent for agent, regions in members.items() if region in regions]
            roster = Roster(
                frame=view.frame,
                process=process,
                agents=agents,
                scanning=[agent for agent in agents if agent in scanning],
            )
            size_bytes = self.context.v2x.publish("roster", roster, region=region, process=process)
            key = TOPICS["roster"].key(region=region, process=process)
            share_bytes = -(-framed_bytes(key, size_bytes) // max(1, len(agents)))
            for agent in agents:
                if agent in self._uplinks:
                    self._uplinks[agent].add_shared(share_bytes)
        self._scanned = (view.frame, [agent for agent in members if agent in scanning])

    def publish_points_on(self, view: WorldView, agent: str, sensed: Sensed) -> None:
        """Publishes on which vehicles a scan's points lie, for the recorder alone."""
        hit = np.flatnonzero(sensed.points_on)
        if len(hit):
            sighting = Sighting(
                frame=view.frame,
                agent=agent,
                vehicles=[view.ids[n] for n in hit],
                points=sensed.points_on[hit].astype(np.int32),
            )
            self.publish_sighting(sighting)

    def publish_sighting(self, sighting: Sighting) -> None:
        """Publishes a sighting if the truth is recorded."""
        if self._keeps_truth:
            self.context.world.publish("sighting", sighting, agent=sighting.agent)

    def report(self, view: WorldView | None = None) -> None:
        """Publishes metrics of the frames that are done, and of a view's frame in any case."""
        frames: dict[int, tuple[WorldView, list[Upload], list[Span]]] = {}
        if view is not None:
            frames[view.frame] = (view, [], [])
        done, self._left = self._left, []
        for _, uplink in sorted(self._uplinks.items()):
            done += uplink.take_done()
        for upload in done:
            _, uploads, spans = frames.setdefault(upload.frame, (upload.view, [], []))
            uploads += upload.uploads
            spans += upload.spans
        for _, (of, uploads, spans) in sorted(frames.items()):
            wire, self._settled = self._settled, []
            self._publish_metrics(of, uploads, spans, wire)

    def _awaits_plan(self, tick: Tick) -> bool:
        if not (self._lockstep and self._policy.cells):
            return False
        frame, scanned = self._scanned
        uplinks = [self._uplinks[agent] for agent in scanned if agent in self._uplinks]
        if frame != tick.frame - 1 or all(uplink.completed_frame >= frame for uplink in uplinks):
            return False
        if time.monotonic_ns() - self._ticked_ns < PLAN_WAIT_NS:
            return True
        self._drops["plan_missing"] += 1
        self._scanned = (-1, [])
        return False

    def _publish_metrics(
        self, view: WorldView, uploads: list[Upload], spans: list[Span], wire: list[WireCount]
    ) -> None:
        overtaken = sum(uplink.unsent_chunks for uplink in self._uplinks.values())
        drops = Counter(self.context.inbox.drops) + self._drops
        drops["overtaken_chunks"] += overtaken
        metrics = Metrics(
            process=self.context.id,
            frame=view.frame,
            sim_time_ns=view.sim_time_ns,
            spans=spans,
            uploads=uploads,
            wire=wire,
            points=sum(upload.points for upload in uploads),
            drops=dict(+drops),
        )
        self.context.world.publish("metrics", metrics, process=self.context.id)
