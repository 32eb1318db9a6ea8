"""Simulated labelled scans of a junction: a generated one, a user's net, or a scenario's."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from learning.dataset import REACH_M, Kind, ScanRow, SceneSample, SensorPoses, sample_of
from learning.kitti import Label, into_sensor
from learning.sites import Sensors, Site, draw_mounts, draw_site
from perception.arrays import Floats, Floats32, Ints
from protocol.errors import ConfigError
from protocol.geometry import SE3
from protocol.messages import Equipment, is_bystander
from protocol.roadmap import RoadMap
from sensing.config import LidarConfig, Mount, PoseErrorConfig, SceneConfig
from sensing.lidar import Lidar
from sensing.mesh import VehicleShapes
from sensing.noise import stream
from sensing.pose import (
    PoseEstimator,
    clock_error_s,
    driven,
    installed_pose,
    mount_pose,
    pose_above,
)
from sensing.reflectivity import paints_of
from sensing.scene import scene_of
from sensing.terrain import believed_map
from sim_host.config import TrafficConfig
from sim_host.junctions import write_junction
from sim_host.setup import build_setup, traffic_config
from sim_host.world import TrafficState, sample_traffic

_CAVS = (1, 5)
_CAVS_NEAR_M = 100.0  # from the junction's centre
_PAUSE_S = (4.0, 14.0)  # between samples
_PAUSE_NS = 9_000_000_000  # their mean, for errors that change with time
_OVER_ROOF_M = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class LabelledScan:
    """A scan: points (N, 4) with intensity, its labels, and its line of `poses.jsonl`."""

    points: Floats32
    labels: list[Label]
    row: ScanRow


class JunctionScanner:
    """A network with its scene and sensors; `net` is the text of a generated one's net file.

    A site without a junction has its traffic's own net, or the built-in one; `tls` is the signal
    there, which may be left out if there is one only.
    """

    def __init__(
        self, site: Site, samples: int, sensors: Sensors | None = None, tls: str | None = None
    ) -> None:
        self.site = site
        self.net = ""
        with tempfile.TemporaryDirectory(prefix="cpnet-") as scratch:
            folder = Path(scratch)
            scenario = {
                "traffic": self._traffic(folder).model_dump(),
                "scene": site.scene.model_dump(),
                "junctions": None if tls is None else [tls],
            }
            setup = build_setup(scenario | {"seed": site.seed}, folder)
            scene = scene_of(setup, site.scene, site.seed)
            states = sample_traffic(setup, folder, scene.terrain, site.seed, self._steps(samples))
            self._states = [state.with_parked(setup) for state in states]
        self.road_map: RoadMap = believed_map(setup.road_map, site.scene, site.seed)
        self._true_map = setup.road_map
        self._sensors = sensors or Sensors.drawn(site)
        given = self._sensors.mounts
        self.mounts: list[Mount] = draw_mounts(site, setup.road_map) if given is None else [*given]
        self._terrain = scene.terrain
        self._shapes = VehicleShapes.from_setup(setup)
        self._classes = {kind.name: kind.object_class for kind in setup.vehicle_types}
        self._lidars = {
            config: Lidar(config, scene, self._shapes)
            for config in {self._sensors.roadside, self._sensors.vehicle}
        }

    def scans(self) -> Iterator[LabelledScan]:
        """Yields every sample's scans: roadside units first, then CAVs."""
        for frame, bodies in enumerate(self._states):
            sizes_m = self._shapes.bodies(bodies.types).size_m
            boxes_m = _boxes(bodies.poses, sizes_m)
            for mount in self.mounts:
                pose = mount_pose(mount, self._true_map, self._terrain)
                true = installed_pose(pose, self._sensors.pose, self.site.seed, mount.id)
                then = self._at_clock(bodies, mount.id)
                yield self._scan((frame, mount.id, "roadside"), (true, pose), then, boxes_m)
            for own in self._cavs(frame, bodies):
                name = bodies.ids[own]
                then = self._at_clock(bodies, name)
                poses = self._on_roof(frame, name, then.poses[own], float(sizes_m[own, 2]))
                yield self._scan((frame, name, "vehicle"), poses, then, boxes_m)

    def _at_clock(self, bodies: TrafficState, agent: str) -> TrafficState:
        """Returns the bodies at the time of an agent's scan, by its clock error."""
        late_s = clock_error_s(self._sensors.pose, self.site.seed, agent)
        ahead_m = bodies.speeds_mps.astype(np.float64) * late_s
        return replace(bodies, poses=driven(bodies.poses, ahead_m)) if late_s else bodies

    def _traffic(self, folder: Path) -> TrafficConfig:
        """Returns the traffic, on the site's own junction if it has one."""
        if self.site.junction is None:
            return self.site.traffic
        path = write_junction(folder, self.site.name, self.site.junction)
        self.net = path.read_text("utf-8")
        return self.site.traffic.model_copy(update={"net": str(path)})

    def _steps(self, samples: int) -> list[int]:
        pauses_s = stream(self.site.seed, "pauses").uniform(*_PAUSE_S, size=samples)
        pauses_s[0] = self.site.warm_up_s
        at = np.cumsum(np.round(pauses_s / self.site.traffic.step_s)).astype(int)
        return [int(step) for step in at]

    def _cavs(self, frame: int, bodies: TrafficState) -> list[int]:
        rng = stream(self.site.seed, "cavs", frame)
        centre = np.array(self.road_map.centre[:2])
        away_m = np.linalg.norm(bodies.poses[:, :2] - centre, axis=1)
        drives = np.array([not is_bystander(name) for name in bodies.ids], np.bool_)
        near = np.flatnonzero((away_m < _CAVS_NEAR_M) & drives)
        count = min(len(near), int(rng.integers(_CAVS[0], _CAVS[1] + 1)))
        return sorted(int(index) for index in rng.choice(near, count, replace=False))

    def _on_roof(self, frame: int, name: str, pose: Floats, roof_m: float) -> tuple[SE3, SE3]:
        """Returns the true and the estimated pose of a CAV's sensor."""
        height_m = stream(self.site.seed, "roof", name).uniform(*self._sensors.roof_m)
        height_m = max(height_m, roof_m + _OVER_ROOF_M)
        estimator = PoseEstimator(self._sensors.pose, self.site.seed, name, Equipment.CAV)
        believed = estimator.estimate(pose, frame, frame * _PAUSE_NS)
        return pose_above(pose, height_m), pose_above(believed, height_m)

    def _scan(
        self,
        source: tuple[int, str, Kind],
        poses: tuple[SE3, SE3],
        bodies: TrafficState,
        boxes_m: Floats,
    ) -> LabelledScan:
        """Casts a scan of the bodies where they are then; labels are the frame's boxes (N, 7)."""
        frame, agent, kind = source
        true, believed = poses
        own = bodies.ids.index(agent) if kind == "vehicle" else None
        lidar = self._sensors.lidar(kind)
        seen = self._lidars[lidar].scan(
            true,
            bodies.poses,
            bodies.types,
            own,
            stream(self.site.seed, "scan", agent, frame),
            paints_of(self.site.seed, bodies.ids),
            bodies.speeds_mps,
        )
        cloud = seen.scan.cloud()
        return LabelledScan(
            points=np.column_stack([cloud.points, cloud.intensity]).astype(np.float32),
            labels=self._labels(bodies, into_sensor(boxes_m, true), own, seen.points_on),
            row=ScanRow(
                index=0,
                network=self.site.name,
                frame=frame,
                agent=agent,
                kind=kind,
                map_SE3_sensor=SensorPoses(believed=_rounded(believed), true=_rounded(true)),
                own=None if own is None else bodies.ids[own],
            ),
        )

    def _labels(
        self, bodies: TrafficState, boxes: Floats, own: int | None, points_on: Ints
    ) -> list[Label]:
        """Returns labels of the bodies in reach, of boxes (N, 7) in the sensor frame."""
        near = np.linalg.norm(boxes[:, :3], axis=1) <= REACH_M
        if own is not None:
            near[own] = False
        return [
            Label(
                bodies.ids[n],
                tuple(boxes[n].tolist()),
                int(points_on[n]),
                self._classes[bodies.types[n]],
            )
            for n in np.flatnonzero(near)
        ]


def _boxes(poses: Floats, sizes_m: Floats) -> Floats:
    """Returns boxes (N, 7) of bodies; their middles are those of the tilted bodies."""
    middles = [
        pose_above(pose, height_m / 2).translation
        for pose, height_m in zip(poses, sizes_m[:, 2], strict=True)
    ]
    return np.column_stack([np.array(middles).reshape(-1, 3), sizes_m, poses[:, 5]])


def _rounded(pose: SE3) -> list[float]:
    return [round(value, 7) for value in pose.as_pose().tolist()]


_WARM_UP_S = 60.0  # at least, so that vehicles have come from all sides


def samples_on(
    net: Path, tls: str | None, samples: int, seed: int
) -> tuple[RoadMap, list[SceneSample]]:
    """Returns the net's road map and its samples, some seconds apart, with generated demand.

    Scene and LiDAR are the default ones.

    Raises:
        ConfigError: the net cannot be read or has no such signal.
    """
    if not net.is_file():
        raise ConfigError(f"--net {net}: there is no such file")
    traffic = TrafficConfig(net=str(net.resolve()), step_s=0.5, cav_rate=0.0, radius_m=300.0)
    update = {
        "junction": None,
        "traffic": traffic,
        "scene": SceneConfig(),
        "lidar": LidarConfig(),
    }
    scanner = JunctionScanner(draw_site(seed, 0).model_copy(update=update), samples, tls=tls)
    return scanner.road_map, list(samples_of(scanner))


def scanner_of(scenario: dict[str, Any], samples: int) -> JunctionScanner:
    """Returns the junction of a scenario whose every key has its value, with its sensors.

    Traffic runs on the fixed plan. Mounts, LiDARs, pose errors and seed are the scenario's; the
    vehicles with a LiDAR are drawn anew for every sample, up to five near the junction.

    Raises:
        ConfigError: its files cannot be read, or it plays a recording.
    """
    if scenario.get("recording") is not None:
        raise ConfigError(
            f"recording is {scenario['recording']}: samples are made of simulated traffic, must be "
            "null"
        )
    traffic, lidar = traffic_config(scenario), scenario["lidar"]
    vehicle, height_m = LidarConfig.model_validate(lidar["vehicle"]), scenario["sensor_height_m"]
    sensors = Sensors(
        roadside=LidarConfig.model_validate(lidar["roadside"]),
        vehicle=vehicle,
        mounts=tuple(Mount.model_validate(one) for one in scenario["roadside_mounts"]),
        roof_m=(height_m, height_m),
        pose=PoseErrorConfig.model_validate(scenario["pose"]),
    )
    update = {
        "seed": scenario["seed"],
        "junction": None,
        "traffic": traffic,
        "scene": SceneConfig.model_validate(scenario["scene"]),
        "lidar": vehicle,
        "warm_up_s": max(traffic.warmup_s, _WARM_UP_S),
    }
    site = draw_site(scenario["seed"], 0).model_copy(update=update)
    junctions = scenario.get("junctions")
    if junctions == "all" or len(junctions or ()) > 1:
        raise ConfigError(
            f"junctions is {junctions}: samples are of one; name it with --set junctions=[ID]"
        )
    return JunctionScanner(site, samples, sensors, junctions[0] if junctions else None)


def samples_of(scanner: JunctionScanner) -> Iterator[SceneSample]:
    """Yields the samples in which at least one sensor scanned."""
    for _, group in groupby(scanner.scans(), lambda scan: scan.row.frame):
        scans = list(group)
        clouds = [np.ascontiguousarray(scan.points[:, :3]) for scan in scans]
        yield sample_of([s.row for s in scans], [s.labels for s in scans], clouds)
