"""From a scenario to what every process is given before the first frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

from pydantic import ValidationError

from protocol.errors import ConfigError
from protocol.files import is_file
from protocol.messages import Setup, VehicleType
from protocol.roadmap import RoadMap
from protocol.version import own_version
from sim_host import t_junction
from sim_host.config import TrafficConfig
from sim_host.demand import write_demand
from sim_host.files import UNREADABLE, open_file
from sim_host.meshes import load_meshes, pack
from sim_host.net import road_map
from sim_host.netfile import Net, read_net
from sim_host.polygons import read_polygons
from sim_host.sumo import sumo_home
from sim_host.vehicles import types_of_demand, types_of_files

SUMO_FOLDER = "sumo"
OWN_CONFIG = "world.sumocfg"


def build_setup(scenario: dict[str, Any], run_dir: Path) -> Setup:
    """Reads or generates net and demand; SUMO's files go to `run_dir/sumo`.

    Raises:
        ConfigError: a file is missing or unfit, or the net lacks the signal.
    """
    scenario, traffic = _located(scenario)
    folder = run_dir / SUMO_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    roads, types = _user_world(traffic) if traffic.sumocfg else _own_world(traffic, folder)
    parts, vertices, triangles = pack(load_meshes(sumo_home() / "data" / "3D"))
    outlines = scenario.get("scene", {}).get("polygons")
    rings, heights = read_polygons(Path(outlines), roads.centre) if outlines else ([], [])
    return Setup(
        scenario=scenario,
        road_map=roads,
        vehicle_types=types,
        meshes=parts,
        mesh_vertices=vertices,
        mesh_triangles=triangles,
        polygons=rings,
        polygon_heights_m=heights,
        version=own_version(),
    )


def traffic_config(scenario: dict[str, Any]) -> TrafficConfig:
    """Returns the scenario's traffic section.

    Raises:
        ConfigError: it does not hold what it should.
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
    given = {"net": traffic.net, "sumocfg": traffic.sumocfg}
    paths = {key: str(Path(name).resolve()) for key, name in given.items() if name}
    section = {**scenario.get("traffic", {}), **paths}
    return {**scenario, "traffic": section}, traffic.model_copy(update=paths)


def config_file(traffic: TrafficConfig, run_dir: Path) -> Path:
    """Returns the sumocfg that the world runs: the user's, or the generated one."""
    if traffic.sumocfg:
        return Path(traffic.sumocfg)
    return run_dir / SUMO_FOLDER / OWN_CONFIG


def _own_world(traffic: TrafficConfig, folder: Path) -> tuple[RoadMap, list[VehicleType]]:
    """Takes the user's net or generates the T junction, and writes a demand for it."""
    if traffic.net:
        path = Path(traffic.net)
    else:
        path = t_junction.write_net(folder)
        demand = {**t_junction.DEMAND_VPH_PER_LANE, **traffic.demand_vph_per_lane}
        traffic = traffic.model_copy(update={"demand_vph_per_lane": demand})
    net = read_net(path)
    roads = road_map(net, traffic.tls)
    write_demand(folder / "demand.rou.xml", net, roads.signal, traffic)
    _write_config(folder / OWN_CONFIG, net)
    return roads, types_of_demand(traffic.vehicles)


def _write_config(path: Path, net: Net) -> None:
    path.write_text(
        "<configuration>\n"
        f"  <input><net-file value={quoteattr(str(net.path.resolve()))}/>"
        '<route-files value="demand.rou.xml"/></input>\n'
        "</configuration>\n",
        encoding="utf-8",
    )


def _user_world(traffic: TrafficConfig) -> tuple[RoadMap, list[VehicleType]]:
    files = _files_of(Path(traffic.sumocfg or ""))
    return road_map(read_net(files.net), traffic.tls), types_of_files(files.others)


@dataclass(frozen=True, slots=True)
class _Files:
    """What a sumocfg names: its net, and the files that may hold vehicle types."""

    net: Path
    others: list[Path]


def _files_of(path: Path) -> _Files:
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
    return _Files(net=named["n"][0], others=named["a"] + named["r"])
