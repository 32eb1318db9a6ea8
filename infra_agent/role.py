"""The infra role: the roadside units of a region, each with a LiDAR whose pose was surveyed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.bus import Bus
from protocol.geometry import SE3
from protocol.inbox import Envelope, Presence
from protocol.instances import mounts_in, region_of
from protocol.process import Context
from sensing.config import Mount, PoseErrorConfig
from sensing.lidar_uplink import LidarUplink, LidarUplinks
from sensing.pose import clock_error_s, installed_pose, mount_pose
from sensing.station import Station
from sensing.world_view import WorldView


@dataclass(frozen=True, slots=True, eq=False)
class _Unit:
    """A roadside unit: true and surveyed pose of its sensor, and its clock error."""

    uplink: LidarUplink
    map_SE3_sensor: SE3
    surveyed_SE3_sensor: SE3
    clock_error_s: float


class InfraRole:
    """Runs the mounts at the junctions of the region that stands in the process's id."""

    def __init__(self, context: Context) -> None:
        region = region_of(context.id)
        self._station = Station(context, "roadside", region)
        self._sensors = LidarUplinks(context, "roadside")
        self._buses: list[Bus] = []
        self._pose_error = PoseErrorConfig.model_validate(context.setup.scenario["pose"])
        self._units: list[_Unit] = []
        for given in mounts_in(context.setup.scenario, region):
            self._add(context, Mount.model_validate(given), region)
        self._station.stand_at(
            np.array([unit.map_SE3_sensor.translation[:2] for unit in self._units])
        )
        self._station.open("infra")

    def _add(self, context: Context, mount: Mount, region: str) -> None:
        bus = context.open_v2x()
        radio = self._station.radio(mount.id, bus)
        uplink = self._station.add(self._sensors.uplink(mount.id, bus, radio))
        uplink.enter([region])
        surveyed = mount_pose(mount, context.setup.road_map, self._sensors.terrain)
        config, seed = self._pose_error, self._station.seed
        true = installed_pose(surveyed, config, seed, mount.id)
        self._buses.append(bus)
        self._units.append(_Unit(uplink, true, surveyed, clock_error_s(config, seed, mount.id)))

    def on(self, item: Envelope | Presence) -> None:
        """Handles a tick or the end."""
        self._station.take(item)

    def poll(self) -> None:
        """Scans and uploads for the newest tick."""
        if view := self._station.pop():
            self._run_frame(view)
        self._station.report(view)

    def close(self) -> None:
        """Reports on the last frame and closes the connections."""
        for unit in self._units:
            self._station.close_uplink(unit.uplink.agent)
        self._station.report()
        self._sensors.close()
        for bus in self._buses:
            bus.close()

    def _run_frame(self, view: WorldView) -> None:
        self._station.begin(view)
        uploads, admits = self._station.uploads, self._station.admits
        uplinks = [unit.uplink for unit in self._units]
        scanning = {one.agent for one in uplinks if uploads and admits(one.radio, view)}
        members = {uplink.agent: self._station.regions for uplink in uplinks}
        self._station.publish_rosters(view, members, scanning)
        for unit in self._units:
            if unit.uplink.agent in scanning:
                sensed = unit.uplink.sense_and_send(
                    view.later(unit.clock_error_s),
                    map_SE3_sensor=unit.map_SE3_sensor,
                    estimated_SE3_sensor=unit.surveyed_SE3_sensor,
                    own=None,
                )
                self._station.publish_points_on(view, unit.uplink.agent, sensed)
