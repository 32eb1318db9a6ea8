"""Vehicle types of a user's own files, and their buildings."""

from pathlib import Path

import pytest

from protocol.errors import ConfigError
from protocol.messages import ObjectClass
from sim_host.demand import mesh_for, object_class_of, types_of_files
from sim_host.setup import read_polygons


def test_types_are_read_with_sumos_defaults_for_what_is_not_said(tmp_path: Path) -> None:
    path = tmp_path / "types.rou.xml"
    path.write_text(
        '<routes><vTypeDistribution id="d"><vType id="tall" height="1.9" length="4"/>'
        '</vTypeDistribution><vType id="line5" vClass="bus"/>'
        '<vehicle id="v" type="tall" depart="0"><route edges="a"/></vehicle></routes>'
    )
    types = {kind.name: kind for kind in types_of_files([path])}
    assert (types["tall"].length_m, types["tall"].width_m, types["tall"].mesh) == (
        4.0,
        1.8,
        "microcargo",
    )
    assert (types["line5"].length_m, types["line5"].mesh) == (12.0, "bus")
    assert types["DEFAULT_VEHTYPE"].mesh == "car"


@pytest.mark.parametrize("v_class", ["tram", "rail_fast", "ship"])
def test_what_runs_on_rails_or_floats_is_a_box_and_a_truck(v_class: str) -> None:
    assert mesh_for(v_class, 1.5) == "box"
    assert object_class_of(v_class) == ObjectClass.TRUCK


@pytest.mark.parametrize(
    ("v_class", "mesh", "object_class"),
    [
        ("passenger", "car", ObjectClass.CAR),
        ("delivery", "minibus", ObjectClass.CAR),
        ("trailer", "articulated", ObjectClass.TRUCK),
        ("bus", "bus", ObjectClass.TRUCK),
        ("bicycle", "bicycle", ObjectClass.TWO_WHEELER),
        ("pedestrian", "pedestrian", ObjectClass.PEDESTRIAN),
    ],
)
def test_a_class_of_vehicles_has_its_shape_and_name(
    v_class: str, mesh: str, object_class: ObjectClass
) -> None:
    assert (mesh_for(v_class, 1.5), object_class_of(v_class)) == (mesh, object_class)


@pytest.mark.parametrize("text", ["<routes>", '<routes><vType id="a" length="x"/></routes>'])
def test_a_broken_route_file_is_a_configuration_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "broken.rou.xml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"broken\.rou\.xml"):
        types_of_files([path])


POLYGONS = """<additional>
<poly id="a" type="building.house" shape="0,0 10,0 10,10 0,0"><param key="height" value="6"/></poly>
<poly id="b" type="building" shape="20,0 30,0 30,10"/>
<poly id="c" type="landuse.grass" shape="0,0 100,0 100,100"/>
<poly id="d" type="building" shape="9000,0 9010,0 9010,10"/>
</additional>"""


def test_buildings_near_the_signal_are_read_with_their_heights(tmp_path: Path) -> None:
    path = tmp_path / "town.poly.xml"
    path.write_text(POLYGONS)
    rings, heights = read_polygons(path, [(0.0, 0.0, 0.0)])
    assert rings == [[(0, 0), (10, 0), (10, 10)], [(20, 0), (30, 0), (30, 10)]]
    assert heights == [6.0, 10.0]


@pytest.mark.parametrize(
    ("text", "error_text"),
    [
        ("<additional>", "no SUMO polygon file"),
        ('<a><poly id="a" shape="1,b 2,3 4,5"/></a>', "no SUMO polygon file"),
        ('<a><poly id="a" geo="true" shape="1,1 2,3 4,5"/></a>', "polyconvert"),
    ],
)
def test_an_unfit_polygon_file_is_a_configuration_error(
    tmp_path: Path, text: str, error_text: str
) -> None:
    path = tmp_path / "town.poly.xml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=error_text):
        read_polygons(path, [(0.0, 0.0, 0.0)])
    with pytest.raises(ConfigError, match="does not exist"):
        read_polygons(tmp_path / "none.poly.xml", [(0.0, 0.0, 0.0)])
