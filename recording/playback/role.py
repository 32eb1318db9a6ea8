"""The player role: publishes, frame by frame, the recorded messages of one process of agents."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path

from protocol.bus import Bus
from protocol.inbox import Envelope, Presence
from protocol.instances import region_of, role_of
from protocol.messages import AgentPose
from protocol.process import Context
from recording.config import ReplayConfig
from recording.mcap.reader import McapReader
from recording.playback.frames import (
    AGENT_TOPICS,
    FRAME_TOPIC,
    AgentFrame,
    Pace,
    RecordedFrames,
    ReplayedUpload,
    agent_frames,
)
from sensing.radio import ENVELOPE_BYTES, AgentKind, Radio
from sensing.station import Station
from sensing.uplink import Uplink, UplinkContext
from sensing.world_view import WorldView
from vehicle_agent.role import Connections

FORGET_FRAMES = 600  # an agent whose link was full for so long is assumed to have left


class PlayerRole:
    """Stands in for one process of agents, under its id.

    All that depends on the link is of this run: which chunks leave, when they arrive, which frames
    an agent leaves out because its link is full. What the recording lacks stays missing.
    """

    def __init__(self, context: Context, frames: RecordedFrames) -> None:
        scenario = context.setup.scenario
        role = role_of(context.id)
        self._kind: AgentKind = "roadside" if role == "infra" else "vehicle"
        self._context = context
        self._frames = frames
        self._lockstep = scenario["mode"] == "lockstep"
        self._speed = ReplayConfig.model_validate(scenario["replay"]).speed
        self._period_ns = round(scenario["frame_period_s"] * 1e9)
        self._station = Station(context, self._kind, region_of(context.id), sees_bodies=False)
        self._terms = UplinkContext(context.id, lockstep=self._lockstep, period_ns=self._period_ns)
        self._connections = Connections(context.open_v2x, wait=self._lockstep)
        self._shapes_poses = self._station.link.channel(scenario["mode"]) == "emulated"
        self._seen: dict[str, int] = {}
        self._buses: dict[str, Bus] = {}
        self._radios: dict[str, Radio] = {}
        self._ways: dict[str, Uplink] = {}
        self._station.open(role)

    @classmethod
    def build(cls, context: Context) -> PlayerRole:
        """Opens the recording that the scenario names.

        Raises:
            ConfigError: it cannot be read.
        """
        recording = McapReader(
            Path(ReplayConfig.model_validate(context.setup.scenario["replay"]).recording)
        )
        frames = RecordedFrames(recording.messages([*AGENT_TOPICS, FRAME_TOPIC]))
        frames.first()  # is read before the first tick, which would be late otherwise
        return cls(context, frames)

    def on(self, item: Envelope | Presence) -> None:
        """Takes a tick, a plan or the end."""
        self._station.take(item)

    def poll(self) -> None:
        """Plays the newest frame."""
        if view := self._station.pop():
            self._play(view)
        self._station.report(view)

    def close(self) -> None:
        """Reports on the last frame and closes every agent's connection."""
        self._forget_all_but(set())
        self._station.report()
        self._connections.close()

    def _play(self, view: WorldView) -> None:
        begun_ns = time.monotonic_ns()
        published = agent_frames(self._context.id, self._kind, self._frames.take(view.frame))
        drops = {"late_in_recording": self._frames.late, "absurd_in_recording": self._frames.absurd}
        self._context.inbox.drops |= {reason: n for reason, n in drops.items() if n}
        self._seen |= dict.fromkeys(published, view.frame)
        here = {
            agent: recorded
            for agent, recorded in published.items()
            if self._connect(agent, recorded)
        }
        self._station.begin(view)
        self._forget_all_but({a for a, n in self._seen.items() if n > view.frame - FORGET_FRAMES})
        admitted = {a for a in here if self._station.admits(self._radios[a], view)}
        mine = [a for a in here if a in admitted or self._kind == "roadside"]
        scanning = [agent for agent in mine if agent in admitted and here[agent].parts]
        members = {agent: here[agent].regions for agent in mine}
        self._station.publish_rosters(view, members, scanning)
        pace = self._pace(published, begun_ns)
        for agent in sorted(admitted, key=mine.index):
            self._say(view, agent, here[agent], pace)

    def _say(self, view: WorldView, agent: str, recorded: AgentFrame, pace: Pace | None) -> None:
        if recorded.pose is not None:
            self._say_pose(view, agent, recorded.pose, recorded.regions)
        if recorded.parts:
            self._ways[agent].enter(recorded.regions)
            self._ways[agent].submit(ReplayedUpload(view, self._ways[agent], recorded, pace))
        if recorded.sighting is not None:
            self._station.publish_sighting(recorded.sighting)

    def _say_pose(
        self, view: WorldView, agent: str, pose: AgentPose, regions: Iterable[str]
    ) -> None:
        for region in regions:
            passage = self._radios[agent].transmit(view.sim_time_ns, ENVELOPE_BYTES, is_chunk=False)
            arrival = {"arrival_sim_ns": passage and passage.arrival_ns}
            where = {"region": region, "process": self._context.id, "agent": agent}
            self._buses[agent].publish("pose", pose.model_copy(update=arrival), **where)

    def _pace(self, published: dict[str, AgentFrame], begun_ns: int) -> Pace | None:
        starts = [w.sense_start_ns for w in published.values() if w.sense_start_ns is not None]
        if self._lockstep or not starts:
            return None
        return Pace(min(starts), begun_ns, self._period_ns, self._speed)

    def _connect(self, agent: str, recorded: AgentFrame) -> bool:
        """Gives a newcomer its connection and radio; false while the connection is being opened."""
        if agent in self._radios:
            return True
        has_own = recorded.has_sensor or self._shapes_poses
        bus = self._connections.get(agent) if has_own else self._context.v2x
        if bus is None:
            return False
        self._buses[agent] = bus
        self._radios[agent] = radio = self._station.radio(agent, bus)
        if recorded.has_sensor:
            self._ways[agent] = self._station.add(Uplink(agent, bus, radio, self._terms))
        return True

    def _forget_all_but(self, present: set[str]) -> None:
        for agent in sorted(self._ways.keys() - present):
            del self._ways[agent]
            self._station.close_uplink(agent)
        for known in (self._buses, self._radios, self._seen):
            for agent in sorted(known.keys() - present):
                del known[agent]
        self._connections.close_all_but(present)
