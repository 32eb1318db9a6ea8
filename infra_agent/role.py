"""The infra role: a roadside unit with one LiDAR, whose pose was surveyed."""

from __future__ import annotations

from protocol.inbox import Envelope, Presence
from protocol.messages import Tick
from protocol.process import Context
from sensing.config import Mount
from sensing.lidar_uplink import LidarUplinks
from sensing.pose import mount_pose
from sensing.station import Station


class InfraRole:
    """Runs the mount of the scenario's list whose index is the number in the process's id."""

    def __init__(self, context: Context) -> None:
        number = int(context.id.rpartition("-")[2])
        mount = Mount.model_validate(context.setup.scenario["roadside_mounts"][number])
        self._station = Station(context, "roadside")
        self._sensors = LidarUplinks(context, "roadside")
        self._map_SE3_sensor = mount_pose(mount, context.setup.road_map, self._sensors.terrain)
        self._bus = context.open_v2x()
        radio = self._station.radio(mount.id, self._bus)
        self._uplink = self._station.add(self._sensors.uplink(mount.id, self._bus, radio))
        self._station.open("infra")

    def on(self, item: Envelope | Presence) -> None:
        """Takes a tick or the end."""
        self._station.take(item)

    def poll(self) -> None:
        """Senses and publishes for the newest tick."""
        if tick := self._station.pop():
            self._run_frame(tick)
        self._station.report(tick)

    def close(self) -> None:
        """Reports on the last frame and closes the connection."""
        self._station.close_uplink(self._uplink.agent)
        self._station.report()
        self._sensors.close()
        self._bus.close()

    def _run_frame(self, tick: Tick) -> None:
        agent, pose = self._uplink.agent, self._map_SE3_sensor
        self._station.begin(tick)
        scans = self._station.uploads and self._station.admits(self._uplink.radio, tick)
        self._station.publish_roster(tick, [agent], [agent] if scans else [])
        if scans:
            sensed = self._uplink.sense_and_send(
                tick, map_SE3_sensor=pose, estimated_SE3_sensor=pose, own=None
            )
            self._station.publish_points_on(tick, agent, sensed)
