"""Random draws for each network: junction, traffic, scene, weather, LiDARs and their mounts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from pydantic import Field

from learning.dataset import Kind
from protocol.config import Section
from protocol.roadmap import RoadMap
from sensing.config import LidarConfig, Mount, PoseErrorConfig, SceneConfig
from sensing.noise import stream
from sensing.road import RoadArea
from sensing.sensor_models import SENSOR_MODELS
from sim_host.config import MeshName, TrafficConfig, VehicleSpec
from sim_host.junctions import Junction, draw_junction

_TALL: dict[MeshName, tuple[tuple[float, float], ...]] = {  # ranges of length, width, height
    "car": ((3.5, 5.1), (1.6, 2.0), (1.35, 1.85)),
    "microcargo": ((3.9, 5.6), (1.65, 2.1), (1.75, 2.5)),
    "minibus": ((4.9, 7.0), (1.85, 2.3), (1.9, 2.8)),
}
_USUAL_FOV_DEG = (2.0, -24.9)
_OTHER_FOVS_DEG = ((10.0, -30.0), (15.0, -25.0), (3.0, -25.0), (5.0, -20.0))
_RSU_DISTANCE_M = (6.0, 45.0)  # from the junction's centre to a roadside unit
_CLEARANCE_M = 0.6
_MOST_PARKED_PER_100M = 15.0  # which is a car in nearly every space


class Site(Section):
    """A network without its sensors' mounts, which depend on the roads."""

    number: int
    seed: int
    junction: Junction | None = Field(description="none: that of the traffic")
    traffic: TrafficConfig
    scene: SceneConfig
    pose: PoseErrorConfig = PoseErrorConfig()
    lidar: LidarConfig = Field(description="of all sensors at this junction")
    warm_up_s: float
    roof_m: tuple[float, float] = Field(description="range of the CAVs' sensor heights")

    @property
    def name(self) -> str:
        """The network's name."""
        return f"network-{self.number:03d}"


World = dict[str, Any]
"""Scenario sections that describe the world: traffic, lidar, pose, scene."""


def draw_site(
    seed: int, number: int, world: World | None = None, furniture_per_100m: float = 0.0
) -> Site:
    """Draws a network by its number; it does not depend on how many there are.

    Where a `world` is given, kinds of vehicles and errors are its own; sizes, shares and sensors
    are drawn about them. Of `furniture_per_100m` a share is drawn; where it is not zero, so are the
    parked cars, from none to a car in each space.
    """
    rng = stream(seed, "site", number)
    junction = draw_junction(stream(seed, "junction", number))
    approaches = [f"{arm.name}_in" for arm in junction.arms if arm.lanes_in]
    site = Site(
        number=number,
        seed=int(rng.integers(2**31)),
        junction=junction,
        traffic=TrafficConfig(
            step_s=0.5,
            demand_vph_per_lane={
                edge: round(float(rng.uniform(120, 650)), 1) for edge in approaches
            },
            vehicles=_vehicles(rng),
            cav_rate=0.0,  # the vehicles with a LiDAR are drawn anew for every sample
            radius_m=300.0,
        ),
        scene=_scene(rng, furniture_per_100m * stream(seed, "furniture", number).random()),
        lidar=_lidar(rng),
        warm_up_s=float(rng.integers(60, 151)),
        roof_m=(1.6, 2.6),
    )
    site = site if world is None else _in_world(site, world, stream(seed, "world", number))
    if not furniture_per_100m:
        return site
    parked = round(float(stream(seed, "parked cars", number).uniform(0, _MOST_PARKED_PER_100M)), 1)
    return site.model_copy(
        update={"traffic": site.traffic.model_copy(update={"parked_per_100m": parked})}
    )


def _in_world(site: Site, world: World, rng: np.random.Generator) -> Site:
    """Returns a site whose traffic, sensors, poses and map are as in a scenario's world."""
    traffic, scene = world["traffic"], world["scene"]
    kept = site.traffic.model_dump(include=_DRAWN)
    vehicles = [_varied(VehicleSpec.model_validate(one), rng) for one in traffic["vehicles"]]
    return site.model_copy(
        update={
            "traffic": TrafficConfig.model_validate(traffic | kept | {"vehicles": vehicles}),
            "scene": site.scene.model_copy(update={"map_height_std_m": scene["map_height_std_m"]}),
            "pose": PoseErrorConfig.model_validate(world["pose"]),
            "lidar": _sensor(site.lidar, world["lidar"]["vehicle"], rng),
        }
    )


_DRAWN = {"step_s", "demand_vph_per_lane", "cav_rate", "radius_m"}
_VARIED_SHARE = (0.3, 3.0)
_RARE_SHARE = (1.0, 6.0)  # of classes other than car and van, to have enough to learn from
_VARIED_SIZE = (0.93, 1.07)


def _varied(spec: VehicleSpec, rng: np.random.Generator) -> VehicleSpec:
    """Returns a kind of vehicle with its sizes and its share drawn about those given."""
    length, width, height = rng.uniform(*_VARIED_SIZE, 3)
    is_rare = spec.v_class not in ("passenger", "delivery")
    share = np.exp(rng.uniform(*np.log(_RARE_SHARE if is_rare else _VARIED_SHARE)))
    return spec.model_copy(
        update={
            "length_m": round(spec.length_m * length, 2),
            "width_m": round(min(spec.width_m * width, 2.6), 2),
            "height_m": round(spec.height_m * height, 2),
            "share": round(spec.share * float(share), 4),
        }
    )


def _sensor(drawn: LidarConfig, given: dict[str, Any], rng: np.random.Generator) -> LidarConfig:
    """Returns a world's sensor; one time in two with other rings: drawn, or those of a real one."""
    which = rng.random()
    if which < 0.5:
        return LidarConfig.model_validate(given)
    if which < 0.75:
        drawn = LidarConfig(model=rng.choice(sorted(SENSOR_MODELS)))
    return LidarConfig.model_validate(given | drawn.model_dump(include=_RINGS))


_RINGS = {"model", "channels", "points_per_second", "upper_fov", "lower_fov"}


def draw_mounts(site: Site, road_map: RoadMap) -> list[Mount]:
    """Draws one roadside unit or, one time in four, two: at the centre or beside the road."""
    rng = stream(site.seed, "mounts")
    centre = np.array(road_map.centre[:2])
    area = RoadArea(road_map)
    feet = np.concatenate(
        [edge.points + edge.outward * rng.uniform(0.9, 3.0) for edge in area.edges()]
    )
    away_m = np.linalg.norm(feet - centre, axis=1)
    near = (away_m > _RSU_DISTANCE_M[0]) & (away_m < _RSU_DISTANCE_M[1])
    feet = feet[near & (area.clearance_m(feet) > _CLEARANCE_M)] - centre
    mounts = []
    for number in range(1 + int(rng.random() < 0.25)):
        central = number == 0 and rng.random() < 0.35
        x, y = (0.0, 0.0) if central or not len(feet) else feet[rng.integers(len(feet))].tolist()
        mount = Mount(
            id=f"rsu-{number}",
            x_m=round(x, 2),
            y_m=round(y, 2),
            height_m=round(rng.uniform(2.5, 7.0), 2),
            yaw_deg=round(rng.uniform(-180, 180), 1),
        )
        mounts.append(mount)
    return mounts


def _vehicles(rng: np.random.Generator) -> list[VehicleSpec]:
    names: list[MeshName] = ["car"] * int(rng.integers(3, 6))
    names += [mesh for mesh in get_args(MeshName) if mesh in _TALL and rng.random() < 0.7]
    weights = {"car": (0.5, 1.5), "microcargo": (0.1, 0.5), "minibus": (0.05, 0.3)}
    specs = []
    for number, mesh in enumerate(names):
        length_m, width_m, height_m = (round(rng.uniform(*span), 2) for span in _TALL[mesh])
        specs.append(
            VehicleSpec(
                name=f"{mesh}{number}",
                mesh=mesh,
                length_m=length_m,
                width_m=width_m,
                height_m=height_m,
                share=round(rng.uniform(*weights[mesh]), 3),
            )
        )
    return specs


def _scene(rng: np.random.Generator, furniture_per_100m: float) -> SceneConfig:
    return SceneConfig(
        furniture_per_100m=round(furniture_per_100m, 2),
        terrain_amplitude_m=round(rng.uniform(0, 0.25), 3),
        kerb_height_m=float(rng.choice([0.0, 0.08, 0.12, 0.15], p=[0.15, 0.2, 0.4, 0.25])),
        sidewalk_width_m=round(rng.uniform(1.0, 4.5), 2),
        building_setback_m=round(rng.uniform(4, 22), 2),
        building_density=round(rng.uniform(0, 0.95), 3),
        pole_spacing_m=round(rng.uniform(14, 60), 1),
        trees_per_100m=round(rng.uniform(0, 10), 2),
    )


def _lidar(rng: np.random.Generator) -> LidarConfig:
    """Draws mostly the usual 64 x 1800 beams, and a weather."""
    channels = 64 if rng.random() < 0.8 else 32
    upper, lower = _USUAL_FOV_DEG
    if rng.random() < 0.2:
        upper, lower = _OTHER_FOVS_DEG[rng.integers(len(_OTHER_FOVS_DEG))]
    bad = rng.random() < 0.2  # rain or fog
    return LidarConfig(
        channels=channels,
        points_per_second=channels * 18_000,
        upper_fov=upper,
        lower_fov=lower,
        atmosphere_attenuation_rate=round(rng.uniform(0.008, 0.03) if bad else 0.004, 4),
        dropoff_general_rate=round(rng.uniform(0.15, 0.4) if bad else rng.uniform(0.05, 0.15), 3),
        noise_stddev=round(rng.uniform(0.02, 0.04) if bad else rng.uniform(0.01, 0.025), 4),
    )


@dataclass(frozen=True, slots=True)
class Sensors:
    """LiDARs of roadside units and CAVs, their mounts, and the pose errors of CAVs.

    Without `mounts`, roadside units are drawn at random. `roof_m` is the range of the CAVs' sensor
    heights.
    """

    roadside: LidarConfig
    vehicle: LidarConfig
    mounts: tuple[Mount, ...] | None
    roof_m: tuple[float, float]
    pose: PoseErrorConfig

    @classmethod
    def drawn(cls, site: Site) -> Sensors:
        """Returns those of a generated network."""
        return cls(site.lidar, site.lidar, None, site.roof_m, site.pose)

    def lidar(self, kind: Kind) -> LidarConfig:
        """Returns the LiDAR of roadside units or of CAVs."""
        return self.roadside if kind == "roadside" else self.vehicle
