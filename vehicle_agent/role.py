"""The vehicle role: CAVs sense, encode and upload; CVs report their pose."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor

from protocol.bus import Bus
from protocol.errors import MessageError
from protocol.geometry import SE3, Floats
from protocol.inbox import Envelope, Presence
from protocol.messages import AgentPose, Equipment, TileBodies
from protocol.process import Context
from sensing.config import PoseErrorConfig, UploadConfig
from sensing.lidar_uplink import LidarUplink, LidarUplinks
from sensing.pose import PoseEstimator, clock_error_s, position_std_m
from sensing.radio import ENVELOPE_BYTES, Radio
from sensing.regions import RegionTracker
from sensing.station import Station
from sensing.world_view import WorldView

CV_RANGE_M = 10.0  # a vehicle without sensor belongs to the region where it is


class Connections:
    """The V2X connections of a process's CAVs, one each, opened on first use.

    Over a mobile network that takes several round trips: with `wait` false it is done in the
    background, so that a new agent does not delay the others of its process.
    """

    def __init__(self, open_v2x: Callable[[], Bus], *, wait: bool) -> None:
        self._open_v2x = open_v2x
        self._wait = wait
        self._buses: dict[str, Future[Bus]] = {}
        self._workers = ThreadPoolExecutor(4, "connect")

    def get(self, agent: str) -> Bus | None:
        """Returns the agent's connection, None while it is being opened.

        Raises:
            BusError: there is no answer.
        """
        if agent not in self._buses:
            self._buses[agent] = self._workers.submit(self._open_v2x)
        opening = self._buses[agent]
        return opening.result() if self._wait or opening.done() else None

    def close_all_but(self, agents: Iterable[str]) -> None:
        """Closes the connections of all agents that are not named."""
        for agent in sorted(self._buses.keys() - set(agents)):
            self._buses.pop(agent).add_done_callback(_close)

    def close(self) -> None:
        """Closes all connections; those that are still being opened as soon as they are."""
        self.close_all_but(())
        self._workers.shutdown()


def _close(opened: Future[Bus]) -> None:
    if opened.exception() is None:
        opened.result().close()


class VehicleRole:
    """Runs every CAV and CV that the world assigned to this process."""

    def __init__(self, context: Context) -> None:
        scenario = context.setup.scenario
        self._context = context
        self._station = Station(context, "vehicle")
        self._sensors = LidarUplinks(context, "vehicle")
        self._pose_error = PoseErrorConfig.model_validate(scenario["pose"])
        self._body_SE3_sensor = SE3.from_pose([0, 0, scenario["sensor_height_m"], 0, 0, 0])
        self._connections = Connections(context.open_v2x, wait=scenario["mode"] == "lockstep")
        self._shapes_poses = self._station.link.channel(scenario["mode"]) == "emulated"
        self._buses: dict[str, Bus] = {}
        self._radios: dict[str, Radio] = {}
        self._uplinks: dict[str, LidarUplink] = {}
        self._estimators: dict[str, PoseEstimator] = {}
        self._clock_errors_s: dict[str, float] = {}
        upload = UploadConfig.model_validate(scenario["upload"])
        regions = self._sensors.regions
        self._reach = {
            Equipment.CAV: RegionTracker(regions, upload.region_range_m),
            Equipment.CV: RegionTracker(regions, CV_RANGE_M),
        }
        self._types = {kind.name: kind for kind in context.setup.vehicle_types}
        self._station.open("vehicle")

    def on(self, item: Envelope | Presence) -> None:
        """Handles a tick, bodies, a plan or the end.

        Raises:
            MessageError: there is a body of a type that the setup does not contain.
        """
        if isinstance(item, Envelope) and isinstance(item.message, TileBodies):
            unknown = sorted(set(item.message.types) - self._types.keys())
            if unknown:
                raise MessageError(f"bodies: unknown vehicle types {unknown[:5]}")
        self._station.take(item)

    def poll(self) -> None:
        """Scans and publishes for the newest tick."""
        if view := self._station.pop():
            self._run_frame(view)
        self._station.report(view)

    def close(self) -> None:
        """Reports on the last frame and closes every agent's connection."""
        self._forget_all_but(set())
        self._station.report()
        self._sensors.close()
        self._connections.close()

    def _run_frame(self, view: WorldView) -> None:
        connected = [i for i in view.hosted if self._connect(view, i)]
        self._station.begin(view)
        self._forget_all_but({view.ids[i] for i in view.hosted})
        mine = [i for i in connected if self._station.admits(self._radios[view.ids[i]], view)]
        scanning = [i for i in mine if view.ids[i] in self._uplinks and self._station.uploads]
        estimated = {i: self._estimated(view, i) for i in mine}
        members = {view.ids[i]: self._regions(view, i, estimated[i]) for i in mine}
        self._station.publish_rosters(view, members, {view.ids[i] for i in scanning})
        for index in mine:
            self._publish_pose(view, index, estimated[index], members[view.ids[index]])
            if index in scanning:
                self._uplinks[view.ids[index]].enter(members[view.ids[index]])
                self._publish_scan(view, index, estimated[index])

    def _estimated(self, view: WorldView, index: int) -> Floats:
        """Returns a vehicle's estimate of its own pose (6,)."""
        agent = view.ids[index]
        pose = view.later(self._clock_errors_s[agent]).poses[index]
        return self._estimators[agent].estimate(pose, view.frame, view.sim_time_ns)

    def _regions(self, view: WorldView, index: int, pose: Floats) -> tuple[str, ...]:
        return self._reach[view.hosted[index]].update(view.ids[index], pose[:2])

    def _publish_pose(
        self, view: WorldView, index: int, pose: Floats, regions: Iterable[str]
    ) -> None:
        agent, equipment = view.ids[index], view.hosted[index]
        kind = self._types[view.types[index]]
        message = AgentPose(
            frame=view.frame,
            sim_time_ns=view.sim_time_ns,
            agent=agent,
            equipment=equipment,
            pose=pose,
            length_m=kind.length_m,
            width_m=kind.width_m,
            height_m=kind.height_m,
            position_std_m=position_std_m(self._pose_error, equipment),
        )
        for region in regions:
            transmission = self._radios[agent].transmit(
                view.sim_time_ns, ENVELOPE_BYTES, is_chunk=False
            )
            arrival = {"arrival_sim_ns": transmission and transmission.arrival_ns}
            self._buses[agent].publish(
                "pose",
                message.model_copy(update=arrival),
                region=region,
                process=self._context.id,
                agent=agent,
            )

    def _connect(self, view: WorldView, index: int) -> bool:
        """Gives a new agent its connection and radio; False while the connection is being opened.

        CVs share the process's own connection, unless relays emulate links: they shape connections.
        """
        agent, is_cav = view.ids[index], view.hosted[index] == Equipment.CAV
        if agent in self._radios:
            return True
        has_own = is_cav or self._shapes_poses
        bus = self._connections.get(agent) if has_own else self._context.v2x
        if bus is None:
            return False
        self._buses[agent] = bus
        self._radios[agent] = radio = self._station.radio(agent, bus)
        config, seed = self._pose_error, self._station.seed
        self._estimators[agent] = PoseEstimator(config, seed, agent, view.hosted[index])
        self._clock_errors_s[agent] = clock_error_s(config, seed, agent)
        if is_cav:
            self._uplinks[agent] = self._station.add(self._sensors.uplink(agent, bus, radio))
        return True

    def _publish_scan(self, view: WorldView, index: int, estimated: Floats) -> None:
        agent = view.ids[index]
        view = view.later(self._clock_errors_s[agent])
        sensed = self._uplinks[agent].sense_and_send(
            view,
            map_SE3_sensor=SE3.from_pose(view.poses[index]) @ self._body_SE3_sensor,
            estimated_SE3_sensor=SE3.from_pose(estimated) @ self._body_SE3_sensor,
            own=index,
        )
        self._station.publish_points_on(view, agent, sensed)

    def _forget_all_but(self, present: set[str]) -> None:
        for agent in sorted(self._uplinks.keys() - present):
            del self._uplinks[agent]
            self._station.close_uplink(agent)
        for known in (self._buses, self._radios, self._estimators, self._clock_errors_s):
            for agent in sorted(known.keys() - present):
                del known[agent]
        for tracker in self._reach.values():
            tracker.forget_all_but(present)
        self._connections.close_all_but(present)
