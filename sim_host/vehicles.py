"""Vehicle types as sensors see them: those of the demand, or of a user's own route files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from protocol.errors import ConfigError
from protocol.files import is_file
from protocol.messages import VehicleType
from sim_host.config import VehicleSpec
from sim_host.files import UNREADABLE, open_file

# SUMO's default length, width and height in m by vClass (page "Vehicle Type Parameter Defaults").
_SIZES: dict[str, tuple[float, float, float]] = {
    "passenger": (5.0, 1.8, 1.5),
    "delivery": (6.5, 2.16, 2.86),
    "emergency": (6.5, 2.16, 2.86),
    "truck": (7.1, 2.4, 2.4),
    "trailer": (16.5, 2.55, 4.0),
    "bus": (12.0, 2.5, 3.4),
    "coach": (14.0, 2.6, 4.0),
    "tram": (22.0, 2.4, 3.2),
    "motorcycle": (2.2, 0.9, 1.5),
    "moped": (2.1, 0.8, 1.7),
    "bicycle": (1.6, 0.65, 1.7),
    "pedestrian": (0.215, 0.478, 1.719),
    "rail_urban": (109.5, 3.0, 3.6),
    "rail": (135.0, 2.84, 3.75),
}
_LARGE = {"delivery", "emergency", "truck", "trailer", "bus", "coach"}
_PLAIN = set(_SIZES) - _LARGE - {"passenger"}
_DEFAULTS = {
    "DEFAULT_VEHTYPE": "passenger",
    "DEFAULT_TAXITYPE": "passenger",
    "DEFAULT_CONTAINERTYPE": "pedestrian",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_RAILTYPE": "rail",
}


def types_of_demand(specs: list[VehicleSpec]) -> list[VehicleType]:
    """Returns the types of the generated demand."""
    return [
        VehicleType(
            name=spec.name,
            mesh=spec.mesh,
            length_m=spec.length_m,
            width_m=spec.width_m,
            height_m=spec.height_m,
        )
        for spec in specs
    ]


def types_of_files(paths: list[Path]) -> list[VehicleType]:
    """Returns SUMO's own types and every `<vType>` in the files, sorted by name.

    Raises:
        ConfigError: a file is missing or is not XML, or a size is no number.
    """
    types = {name: sized(name, v_class) for name, v_class in _DEFAULTS.items()}
    for path in paths:
        for attributes in _v_types(path):
            name = attributes["id"]
            try:
                types[name] = sized(name, attributes.get("vClass", "passenger"), attributes)
            except ValueError as error:
                raise ConfigError(f"vType {name!r} in {path}: {error}") from None
    return [types[name] for name in sorted(types)]


def sized(name: str, v_class: str, given: dict[str, str] | None = None) -> VehicleType:
    """Returns a type with the sizes that are given, SUMO's defaults of its class otherwise."""
    given = given or {}
    length, width, height = _SIZES.get(v_class, _SIZES["passenger"])
    height = float(given.get("height", height))
    return VehicleType(
        name=name,
        mesh=mesh_for(v_class, height),
        length_m=float(given.get("length", length)),
        width_m=float(given.get("width", width)),
        height_m=height,
    )


def mesh_for(v_class: str, height_m: float) -> str:
    """Returns the shape that comes nearest to a class of vehicles."""
    if v_class in _PLAIN or v_class.startswith(("rail", "ship", "subway", "cable")):
        return "box"
    if v_class in _LARGE:
        return "minibus"
    return "microcargo" if height_m > 1.8 else "car"


def _v_types(path: Path) -> Iterator[dict[str, str]]:
    if not is_file(path):
        raise ConfigError(f"file {path}, which the sumocfg names, does not exist")
    try:
        with open_file(path) as stream:
            root: ElementTree.Element | None = None
            for event, element in ElementTree.iterparse(stream, ("start", "end")):
                root = element if root is None else root
                if event == "end" and element.tag == "vType" and "id" in element.attrib:
                    yield dict(element.attrib)
                elif event == "end" and element.tag in ("vehicle", "trip", "flow", "person"):
                    root.clear()  # route files of a city are large
    except UNREADABLE as error:
        raise ConfigError(f"file {path} cannot be read as XML: {error}") from None
