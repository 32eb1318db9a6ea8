"""The setup of a run: scenario, road map, vehicles and buildings, for every process."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
from pydantic import ValidationError

from protocol.config import is_file
from protocol.errors import ConfigError
from protocol.messages import Setup, VehicleType
from protocol.roadmap import RoadMap
from protocol.version import own_version
from sensing.config import SceneConfig
from sim_host.city_demand import write_city_demand
from sim_host.compatible_phases import with_phases
from sim_host.config import TrafficConfig
from sim_host.demand import (
    first_departure_s,
    sized,
    types_of_demand,
    types_of_files,
    write_demand,
)
from sim_host.junctions import DEMAND_VPH_PER_LANE, write_net
from sim_host.limits import MAX_HEIGHT_M
from sim_host.netfile import UNREADABLE, Net, open_file, read_net
from sim_host.networks import NETWORKS, write_grid
from sim_host.parked import draw_parked
from sim_host.pedestrians import PEDESTRIAN_TYPE
from sim_host.regions import resolve_regions
from sim_host.road_map import road_map
from sim_host.sumo import sumo_home
from sim_host.vehicle_meshes import PackedMeshes, load_meshes

_log = logging.getLogger(__name__)

DEFAULT_HEIGHT_M = 10.0
POLYGON_RADIUS_M = 400.0

Ring = list[tuple[float, float]]


def read_polygons(
    path: Path, centres: Sequence[tuple[float, float, float]]
) -> tuple[list[Ring], list[float]]:
    """Returns outlines (map frame) and heights in m of the buildings around any of the centres.

    A building is a `<poly>` whose type holds "building"; if the file has none, every polygon with
    a `height` counts. Heights come from a `<param key="height">`, 10 m otherwise.

    Raises:
        ConfigError: the file is missing, is not XML, or has degrees instead of metres.
    """
    if not is_file(path):
        raise ConfigError(f"scene.polygons: file {path} does not exist")
    try:
        rows = list(ElementTree.parse(path).getroot().iter("poly"))
        found = [(_ring(row), _height(row), "building" in row.get("type", "")) for row in rows]
    except (ElementTree.ParseError, OSError, ValueError) as error:
        raise ConfigError(f"scene.polygons: {path} is no SUMO polygon file: {error}") from None
    if any(row.get("geo") in ("1", "true") for row in rows):
        raise ConfigError(f"scene.polygons: {path} is in degrees; convert it with polyconvert")
    named = any(building for _, _, building in found)
    kept = [
        (ring, height or DEFAULT_HEIGHT_M)
        for ring, height, building in found
        if (building if named else height > 0) and len(ring) >= 3 and _is_near(ring, centres)
    ]
    return [ring for ring, _ in kept], [height for _, height in kept]


def _ring(row: ElementTree.Element) -> Ring:
    ring = []
    for word in row.get("shape", "").split():
        x, y, *_ = (float(number) for number in word.split(","))
        ring.append((x, y))
    return ring[:-1] if len(ring) > 1 and ring[0] == ring[-1] else ring


def _height(row: ElementTree.Element) -> float:
    for param in row.iter("param"):
        if param.get("key") == "height":
            return _checked_height(float(param.get("value", "")))
    return 0.0


def _checked_height(height_m: float) -> float:
    if not 0 <= height_m <= MAX_HEIGHT_M:
        raise ValueError(f"a height is {height_m:g} m, allowed: 0 to {MAX_HEIGHT_M:g}")
    return height_m


def _is_near(ring: Ring, centres: Sequence[tuple[float, float, float]]) -> bool:
    away = np.array(ring)[:, None] - np.array(centres)[:, :2]
    return bool(np.isfinite(away).all() and np.linalg.norm(away, axis=2).min() <= POLYGON_RADIUS_M)


SUMO_FOLDER = "sumo"
OWN_CONFIG = "world.sumocfg"
OWN_ROUTES = "demand.rou.xml"


def build_setup(scenario: dict[str, Any], run_dir: Path) -> Setup:
    """Reads or generates net and demand; SUMO's files go to `run_dir/sumo`.

    Raises:
        ConfigError: a file is missing or unfit, or the net lacks the signal.
    """
    scenario, traffic = _located(scenario)
    folder = run_dir / SUMO_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    junctions = scenario.get("junctions")
    if traffic.sumocfg:
        roads, types = _user_world(traffic, junctions)
    else:
        roads, types = _own_world(traffic, junctions, folder)
    roads = with_greens(roads, scenario.get("cabinet", {}).get("plan_greens_s", []))
    roads = with_phases(roads, scenario.get("signal", {}))
    scenario = resolved(scenario, roads)
    meshes = PackedMeshes.of(load_meshes(sumo_home() / "data" / "3D"))
    outlines = scenario.get("scene", {}).get("polygons")
    centres = [one.centre for one in roads.intersections]
    rings, heights = read_polygons(Path(outlines), centres) if outlines else ([], [])
    scene = SceneConfig.model_validate(scenario.get("scene", {}))
    parked = draw_parked(roads, types, traffic.parked_per_100m, scene, scenario.get("seed", 0))
    return Setup(
        scenario=scenario,
        road_map=roads,
        vehicle_types=types,
        meshes=meshes.parts,
        mesh_vertices=meshes.vertices,
        mesh_triangles=meshes.triangles,
        mesh_materials=meshes.materials,
        polygons=rings,
        polygon_heights_m=heights,
        parked_types=parked.types,
        parked_poses=parked.poses,
        version=own_version(),
    )


def with_greens(roads: RoadMap, greens_s: Sequence[float]) -> RoadMap:
    """Returns the map with these green durations in its only signal's fixed plan; none: unchanged.

    Raises:
        ConfigError: there are several signals, or the plan has another number of greens.
    """
    if not greens_s:
        return roads
    if len(roads.intersections) > 1:
        raise ConfigError("cabinet.plan_greens_s: goes with one signal; these are several")
    (one,) = roads.intersections
    planned = [phase for phase in one.signal.plan if phase.is_green]
    if len(planned) != len(greens_s):
        raise ConfigError(
            f"cabinet.plan_greens_s: {len(greens_s)} durations, the plan of {one.tls} has "
            f"{len(planned)} greens"
        )
    left_s = iter(greens_s)
    plan = [
        phase.model_copy(update={"duration_s": next(left_s)}) if phase.is_green else phase
        for phase in one.signal.plan
    ]
    signal = one.signal.model_copy(update={"plan": plan})
    timed = [one.model_copy(update={"signal": signal})]
    return RoadMap(name=roads.name, lanes=roads.lanes, intersections=timed)


def resolved(scenario: dict[str, Any], roads: RoadMap) -> dict[str, Any]:
    """Returns the scenario with its junctions and regions named, and each mount at a junction.

    Mounts that name no junction stand at each of them: at more than one, with a number.

    Raises:
        ConfigError: regions or mounts do not fit the junctions.
    """
    known = sorted(roads.by_tls)
    mounts: list[dict[str, Any]] = []
    for mount in scenario.get("roadside_mounts", []):
        if mount.get("tls") is not None and mount["tls"] not in known:
            raise ConfigError(
                f"roadside_mounts: {mount['id']} stands at {mount['tls']!r}, which is none of the "
                f"controlled junctions: {', '.join(known[:20])}"
            )
        if mount.get("tls") is not None or len(known) == 1:
            mounts.append({**mount, "tls": mount.get("tls") or known[0]})
            continue
        for number, tls in enumerate(known):
            mounts.append({**mount, "tls": tls, "id": f"{mount['id']}.{number}"})
    regions = resolve_regions(roads, scenario.get("regions", 1))
    found = {"junctions": known, "regions": regions, "roadside_mounts": mounts}
    asked = scenario.get("asked") or {key: scenario[key] for key in found if key in scenario}
    return {**scenario, **found, "asked": asked}


def traffic_config(scenario: dict[str, Any]) -> TrafficConfig:
    """Returns the scenario's traffic section.

    Raises:
        ConfigError: a value is wrong or out of range.
    """
    try:
        return TrafficConfig.model_validate(scenario.get("traffic", {}))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in ("traffic", *first["loc"]))
        raise ConfigError(f"{where}: {first['msg']}") from None


def _located(scenario: dict[str, Any]) -> tuple[dict[str, Any], TrafficConfig]:
    """Returns the scenario with its SUMO files as absolute paths, and its traffic section."""
    traffic = traffic_config(scenario)
    given = {"net": traffic.net, "routes": traffic.routes, "sumocfg": traffic.sumocfg}
    paths = {key: str(Path(name).resolve()) for key, name in given.items() if name}
    section = {**scenario.get("traffic", {}), **paths}
    return {**scenario, "traffic": section}, traffic.model_copy(update=paths)


def config_file(traffic: TrafficConfig, run_dir: Path) -> Path:
    """Returns the sumocfg that the world runs: the user's, or the generated one."""
    if traffic.sumocfg:
        return Path(traffic.sumocfg)
    return run_dir / SUMO_FOLDER / OWN_CONFIG


Junctions = Literal["all"] | Sequence[str] | None


def _own_world(
    traffic: TrafficConfig, junctions: Junctions, folder: Path
) -> tuple[RoadMap, list[VehicleType]]:
    """Takes the user's net or generates the T junction, and writes a demand for it."""
    if traffic.net:
        path = Path(traffic.net)
    elif traffic.network in NETWORKS:
        path, junctions = _write_network(traffic, folder), junctions or "all"
    else:
        path = write_net(folder)
        demand = {**DEMAND_VPH_PER_LANE, **traffic.demand_vph_per_lane}
        traffic = traffic.model_copy(update={"demand_vph_per_lane": demand})
    net = read_net(path)
    roads = road_map(net, junctions)
    if traffic.routes:
        routes = Path(traffic.routes)
        types = types_of_files([routes])
        _write_config(folder / OWN_CONFIG, net, routes, begin_s=first_departure_s(routes))
        return roads, types
    _write_demand(folder / OWN_ROUTES, net, roads, traffic)
    _write_config(folder / OWN_CONFIG, net, Path(OWN_ROUTES))
    types = types_of_demand(traffic.vehicles)
    if traffic.pedestrians_per_hour:
        types.append(sized(PEDESTRIAN_TYPE, "pedestrian"))
    return roads, types


def _write_network(traffic: TrafficConfig, folder: Path) -> Path:
    if traffic.network == "grid":
        return write_grid(folder, traffic.grade, traffic.grid_size)
    return NETWORKS[traffic.network](folder, traffic.grade)


def _write_demand(path: Path, net: Net, roads: RoadMap, traffic: TrafficConfig) -> None:
    """Writes flows over the only signal of a net, or over all of its network."""
    signals = [one.signal for one in roads.intersections]
    if len(signals) == 1 and (traffic.net or traffic.network not in NETWORKS):
        write_demand(path, net, signals[0], traffic)
        return
    if traffic.demand_vph_per_lane:
        raise ConfigError(
            "traffic.demand_vph_per_lane: goes with one signal; with several, traffic.saturation "
            "scales the demand"
        )
    degrees = write_city_demand(path, net, signals, traffic, traffic.saturation)
    _log.info("degree of saturation: %s", {tls: round(x, 2) for tls, x in degrees.items()})


def _write_config(path: Path, net: Net, routes: Path, *, begin_s: float = 0.0) -> None:
    path.write_text(
        "<configuration>\n"
        f"  <input><net-file value={quoteattr(str(net.path.resolve()))}/>"
        f"<route-files value={quoteattr(str(routes))}/></input>\n"
        f'  <time><begin value="{begin_s:g}"/></time>\n'
        "</configuration>\n",
        encoding="utf-8",
    )


def _user_world(traffic: TrafficConfig, junctions: Junctions) -> tuple[RoadMap, list[VehicleType]]:
    files = sumo_files(Path(traffic.sumocfg or ""))
    return road_map(read_net(files.net), junctions), types_of_files(files.others)


@dataclass(frozen=True, slots=True)
class SumoFiles:
    """Files named by a sumocfg: its net, and those that may hold vehicle types."""

    net: Path
    others: list[Path]


def sumo_files(path: Path) -> SumoFiles:
    """Returns the files that a sumocfg names.

    Raises:
        ConfigError: it cannot be read, or names not one net.
    """
    if not is_file(path):
        raise ConfigError(f"traffic.sumocfg: file {path} does not exist")
    try:
        with open_file(path) as stream:
            root = ElementTree.parse(stream).getroot()
    except (*UNREADABLE, ValueError) as error:
        raise ConfigError(f"traffic.sumocfg: {path} cannot be read as XML: {error}") from None
    named = {
        short: [
            path.parent / name.strip()
            for element in root.iter()
            if element.tag in (short, long)
            for name in element.get("value", element.get("v", "")).split(",")
            if name.strip()
        ]
        for short, long in (("n", "net-file"), ("r", "route-files"), ("a", "additional-files"))
    }
    if len(named["n"]) != 1:
        raise ConfigError(f"traffic.sumocfg: {path} names {len(named['n'])} net files, needs one")
    return SumoFiles(net=named["n"][0], others=named["a"] + named["r"])
