"""The vehicle role: one or more CAVs and CVs, those that the world gave to this process."""

from __future__ import annotations

import numpy as np

from protocol.errors import MessageError
from protocol.geometry import SE3, Floats
from protocol.inbox import Envelope, Presence
from protocol.messages import AgentPose, Equipment, Tick
from protocol.process import Context
from sensing.config import PoseErrorConfig
from sensing.noise import stream
from sensing.pose import believed_pose, position_std_m
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
        self._station.open("vehicle")

    def on(self, item: Envelope | Presence) -> None:
        """Takes a tick or the end.

        Raises:
            MessageError: a tick holds a type of vehicle that the setup does not know.
        """
        if isinstance(item, Envelope) and isinstance(item.message, Tick):
            unknown = sorted(set(item.message.types) - self._types.keys())
            if unknown:
                raise MessageError(f"tick: unknown vehicle types {unknown[:5]}")
        self._station.take(item)

    def poll(self) -> None:
        """Plays the newest frame."""
        if tick := self._station.pop():
            self._play(tick)
        self._station.report(tick)

    def close(self) -> None:
        """Hangs up every CAV's connection."""
        self._hang_up(set())

    def _play(self, tick: Tick) -> None:
        mine = self._hosted(tick)
        cavs = [i for i in mine if tick.equipment[i] == Equipment.CAV]
        scanning = cavs if self._station.uploads else []
        names = [tick.ids[i] for i in scanning]
        self._station.publish_roster(tick, [tick.ids[i] for i in mine], names)
        self._hang_up(set(names))
        for agent in names:
            self._uplink(agent)
        self._station.settle(tick)
        for index in mine:
            believed = self._publish_pose(tick, index)
            if index in scanning:
                self._publish_scan(tick, index, believed)

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
        )
        self._context.v2x.publish("pose", message, region=self._station.region, agent=agent)
        return pose

    def _publish_scan(self, tick: Tick, index: int, believed: Floats) -> None:
        self._uplink(tick.ids[index]).sense_and_send(
            tick,
            map_SE3_sensor=SE3.from_pose(tick.poses[index]) @ self._body_SE3_sensor,
            believed_SE3_sensor=SE3.from_pose(believed) @ self._body_SE3_sensor,
            own=index,
        )

    def _uplink(self, agent: str) -> Uplink:
        if agent not in self._uplinks:
            self._uplinks[agent] = self._station.uplink(agent, self._context.open_v2x())
        return self._uplinks[agent]

    def _hang_up(self, still_here: set[str]) -> None:
        for agent in sorted(self._uplinks.keys() - still_here):
            del self._uplinks[agent]
            self._station.hang_up(agent)
