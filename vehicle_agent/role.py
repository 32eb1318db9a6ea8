"""The vehicle role: one or more CAVs and CVs, those that the world gave to this process."""

from __future__ import annotations

import numpy as np

from protocol.geometry import SE3, Floats
from protocol.inbox import Envelope, Presence
from protocol.messages import AgentPose, Equipment, Span, Tick, Upload
from protocol.process import Context
from sensing.config import PoseErrorConfig
from sensing.noise import stream
from sensing.pose import believed_pose, position_std_m
from sensing.radio import ENVELOPE_BYTES, Radio
from sensing.station import Station
from sensing.uplink import Uplink


class VehicleRole:
    """Plays every CAV and CV whose host is this process."""

    def __init__(self, context: Context) -> None:
        scenario = context.setup.scenario
        self._context = context
        self._station = Station(context, "vehicle")
        self._pose_error = PoseErrorConfig.model_validate(scenario["pose"])
        self._body_SE3_sensor = SE3.from_pose([0, 0, scenario["sensor_height_m"], 0, 0, 0])
        self._types = {kind.name: kind for kind in context.setup.vehicle_types}
        self._uplinks: dict[str, Uplink] = {}
        self._radios: dict[str, Radio] = {}
        self._station.open("vehicle")

    def on(self, item: Envelope | Presence) -> None:
        """Takes a tick or the end."""
        self._station.take(item)

    def poll(self) -> None:
        """Plays the newest frame."""
        if tick := self._station.pop():
            self._play(tick)

    def close(self) -> None:
        """Hangs up every agent's connection."""
        self._hang_up(set())

    def _play(self, tick: Tick) -> None:
        mine = self._hosted(tick)
        present = [tick.ids[i] for i in mine]
        self._hang_up(set(present))
        cavs = [i for i in mine if tick.equipment[i] == Equipment.CAV]
        scanning = [i for i in cavs if not self._is_clogged(tick, tick.ids[i])]
        self._station.publish_roster(tick, present, [tick.ids[i] for i in scanning])
        self._station.note_skipped_scans(len(cavs) - len(scanning))
        for index in mine:
            self._open(tick, index)
        uploads: list[Upload] = []
        spans: list[Span] = []
        for index in mine:
            believed = self._publish_pose(tick, index)
            if index in scanning:
                upload, stages = self._publish_scan(tick, index, believed)
                uploads.append(upload)
                spans += stages
        self._station.publish_metrics(tick, uploads, spans)

    def _hosted(self, tick: Tick) -> list[int]:
        if self._context.id not in tick.processes:
            return []
        host = tick.processes.index(self._context.id)
        return [int(i) for i in np.flatnonzero(tick.hosts == host)]

    def _publish_pose(self, tick: Tick, index: int) -> Floats:
        agent, equipment = tick.ids[index], Equipment(int(tick.equipment[index]))
        rng = stream(self._station.seed, "pose", agent, tick.frame)
        pose = believed_pose(tick.poses[index], self._pose_error, equipment, rng)
        kind = self._types[tick.types[index]]
        passage = self._radios[agent].carry(tick.sim_time_ns, ENVELOPE_BYTES)
        message = AgentPose(
            frame=tick.frame,
            sim_time_ns=tick.sim_time_ns,
            agent=agent,
            equipment=equipment,
            pose=pose,
            length_m=kind.length_m,
            width_m=kind.width_m,
            height_m=kind.height_m,
            position_std_m=position_std_m(self._pose_error, equipment),
            arrival_sim_ns=passage and passage.arrival_ns,
        )
        bus = self._uplinks[agent].bus if agent in self._uplinks else self._context.v2x
        bus.publish("pose", message, region=self._station.region, agent=agent)
        return pose

    def _is_clogged(self, tick: Tick, agent: str) -> bool:
        radio = self._radios.get(agent)
        return radio is not None and radio.is_clogged(tick.sim_time_ns)

    def _open(self, tick: Tick, index: int) -> None:
        """Gives a newcomer its radio; a CAV also has a connection of its own."""
        agent = tick.ids[index]
        if agent in self._radios:
            return
        if tick.equipment[index] != Equipment.CAV:
            self._radios[agent] = self._station.radio(agent, self._context.v2x)
            return
        bus = self._context.open_v2x()
        self._radios[agent] = self._station.radio(agent, bus)
        self._uplinks[agent] = self._station.uplink(agent, bus, self._radios[agent])

    def _publish_scan(self, tick: Tick, index: int, believed: Floats) -> tuple[Upload, list[Span]]:
        return self._uplinks[tick.ids[index]].sense_and_send(
            tick,
            map_SE3_sensor=SE3.from_pose(tick.poses[index]) @ self._body_SE3_sensor,
            believed_SE3_sensor=SE3.from_pose(believed) @ self._body_SE3_sensor,
            own=index,
        )

    def _hang_up(self, still_here: set[str]) -> None:
        for agent in sorted(self._radios.keys() - still_here):
            del self._radios[agent]
            if agent in self._uplinks:
                self._uplinks.pop(agent).bus.close()
