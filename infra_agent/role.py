"""The infra role: the roadside units of a region, each with a LiDAR whose pose was surveyed."""

from __future__ import annotations

import numpy as np

from protocol.bus import Bus
from protocol.geometry import SE3
from protocol.inbox import Envelope, Presence
from protocol.instances import mounts_in, region_of
from protocol.process import Context
from sensing.config import Mount
from sensing.lidar_uplink import LidarUplink, LidarUplinks
from sensing.pose import mount_pose
from sensing.station import Station
from sensing.world_view import WorldView


class InfraRole:
    """Runs the mounts at the junctions of the region that stands in the process's id."""

    def __init__(self, context: Context) -> None:
        region = region_of(context.id)
        self._station = Station(context, "roadside", region)
        self._sensors = LidarUplinks(context, "roadside")
        self._buses: list[Bus] = []
        self._units: list[tuple[LidarUplink, SE3]] = []
        for given in mounts_in(context.setup.scenario, region):
            self._add(context, Mount.model_validate(given), region)
        self._station.stand_at(np.array([pose.translation[:2] for _, pose in self._units]))
        self._station.open("infra")

    def _add(self, context: Context, mount: Mount, region: str) -> None:
        bus = context.open_v2x()
        radio = self._station.radio(mount.id, bus)
        uplink = self._station.add(self._sensors.uplink(mount.id, bus, radio))
        uplink.enter([region])
        pose = mount_pose(mount, context.setup.road_map, self._sensors.terrain)
        self._buses.append(bus)
        self._units.append((uplink, pose))

    def on(self, item: Envelope | Presence) -> None:
        """Takes a tick or the end."""
        self._station.take(item)

    def poll(self) -> None:
        """Senses and publishes for the newest tick."""
        if view := self._station.pop():
            self._run_frame(view)
        self._station.report(view)

    def close(self) -> None:
        """Reports on the last frame and closes the connections."""
        for uplink, _ in self._units:
            self._station.close_uplink(uplink.agent)
        self._station.report()
        self._sensors.close()
        for bus in self._buses:
            bus.close()

    def _run_frame(self, view: WorldView) -> None:
        self._station.begin(view)
        uploads, admits = self._station.uploads, self._station.admits
        scanning = {one.agent for one, _ in self._units if uploads and admits(one.radio, view)}
        members = {uplink.agent: self._station.regions for uplink, _ in self._units}
        self._station.publish_rosters(view, members, scanning)
        for uplink, pose in self._units:
            if uplink.agent in scanning:
                sensed = uplink.sense_and_send(
                    view, map_SE3_sensor=pose, estimated_SE3_sensor=pose, own=None
                )
                self._station.publish_points_on(view, uplink.agent, sensed)
