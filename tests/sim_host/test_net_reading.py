"""Road maps out of nets that are not the built-in one."""

import gzip
from pathlib import Path

import pytest

from protocol.errors import ConfigError
from sim_host.config import TrafficConfig
from sim_host.demand import movements, write_demand
from sim_host.netfile import read_net
from sim_host.road_map import road_map


def lane(edge: str, shape: str, **more: str) -> str:
    function = ' function="internal"' if edge.startswith(":") else ""
    extra = "".join(f' {key}="{value}"' for key, value in more.items())
    return (
        f'<edge id="{edge}"{function}><lane id="{edge}_0" index="0" speed="13" length="100" '
        f'shape="{shape}"{extra}/></edge>'
    )


def connect(a: str, b: str, via: str = "", link: int | None = None) -> str:
    controlled = "" if link is None else f' tl="T" linkIndex="{link}"'
    inside = f' via="{via}"' if via else ""
    return f'<connection from="{a}" to="{b}" fromLane="0" toLane="0"{inside}{controlled}/>'


# Two roads cross; the left-turner's lane within the junction is split, so that its request stands
# at the second half, and link numbers are not those of the requests.
CROSS = [
    lane("w", "-120,0 -10,0"),
    lane("s", "0,-120 0,-10"),
    lane("e", "10,0 120,0"),
    lane("n", "0,10 0,120,3.5"),
    lane("far", "0,900 0,1200"),
    lane("path", "-10,5 10,5", allow="pedestrian"),
    lane(":J_0", "-10,0 10,0"),
    lane(":J_1", "0,-10 0,0"),
    lane(":J_2", "0,0 0,10"),
    '<tlLogic id="T" type="static" programID="0" offset="3">'
    '<param key="linkSignalID:0" value="9"/>'
    '<phase duration="30" state="{green}"/><phase duration="3" state="yy"/></tlLogic>',
    '<junction id="J" type="traffic_light" x="0" y="0" incLanes="w_0 s_0" intLanes=":J_0_0 :J_2_0" '
    'shape="-5,-5 5,-5 5,5"><request index="0" response="00" foes="10" cont="0"/>'
    '<request index="1" response="01" foes="01" cont="1"/></junction>',
    connect("w", "e", ":J_0_0", 1),
    connect("s", "n", ":J_1_0", 0),
    connect(":J_1", "n", ":J_2_0"),
    connect(":J_2", "n"),
    connect(":J_0", "e"),
    connect("n", "far"),
]


def write(tmp_path: Path, green: str = "rG", net: list[str] | None = None) -> Path:
    path = tmp_path / "cross.net.xml"
    body = "\n".join(CROSS if net is None else net).replace("{green}", green)
    path.write_text(f"<net>{body}</net>")
    return path


def test_links_conflicts_and_plan_are_read_by_link_number(tmp_path: Path) -> None:
    signal = road_map(read_net(write(tmp_path)), ["T"]).intersections[0].signal
    assert [(link.index, link.from_lane, link.to_lane) for link in signal.links] == [
        (0, "s_0", "n_0"),
        (1, "w_0", "e_0"),
    ]
    assert signal.conflicts == [(0, 1)]
    assert signal.offset_s == 3
    assert [phase.state for phase in signal.plan] == ["rG", "yy"]


def test_who_must_yield_gets_the_lesser_green(tmp_path: Path) -> None:
    signal = road_map(read_net(write(tmp_path, green="GG")), None).intersections[0].signal
    assert signal.plan[0].state == "gG"  # link 0, from the south, responds to the other


def test_old_and_rare_letters_become_plain_ones(tmp_path: Path) -> None:
    signal = road_map(read_net(write(tmp_path, green="sO")), None).intersections[0].signal
    assert signal.plan[0].state == "rg"


def test_lanes_lead_through_the_junction_and_far_or_foreign_ones_are_left_out(
    tmp_path: Path,
) -> None:
    roads = road_map(read_net(write(tmp_path)), ["T"])
    after = {lane.id: lane.successors for lane in roads.lanes}
    assert after == {
        ":J_0_0": ["e_0"],
        ":J_1_0": [":J_2_0"],
        ":J_2_0": ["n_0"],
        "e_0": [],
        "n_0": [],
        "s_0": [":J_1_0"],
        "w_0": [":J_0_0"],
    }
    assert roads.by_id["n_0"].centreline == [(0, 10, 0), (0, 120, 3.5)]
    assert roads.intersections[0].outline == [(-5, -5), (5, -5), (5, 5)]


def test_a_gzipped_net_is_read_too(tmp_path: Path) -> None:
    plain = write(tmp_path)
    packed = tmp_path / "cross.net.xml.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    unpacked = road_map(read_net(packed), ["T"]).model_dump()
    assert unpacked == road_map(read_net(plain), ["T"]).model_dump()


JOINED = [
    *(lane(name, shape) for name, shape in (("a", "-99,0 -9,0"), ("b", "9,0 40,0"))),
    *(lane(name, shape) for name, shape in (("c", "60,0 150,0"), ("d", "50,-99 50,-9"))),
    *(lane(name, shape) for name, shape in ((":J_0", "-9,0 9,0"), (":K_0", "40,0 60,0"))),
    lane(":K_1", "50,-9 60,0"),
    '<tlLogic id="T" offset="0"><phase duration="9" state="GGr"/><phase duration="9" state="rrG"/>'
    "</tlLogic>",
    '<junction id="J" x="0" y="0" intLanes=":J_0_0" shape="-9,-9 9,9 -9,9">'
    '<request index="0" response="0" foes="0"/></junction>',
    '<junction id="K" x="50" y="0" intLanes=":K_0_0 :K_1_0" shape="41,-9 59,-9 59,9">'
    '<request index="0" response="10" foes="10"/><request index="1" response="00" foes="01"/>'
    "</junction>",
    connect("a", "b", ":J_0_0", 0),
    connect("b", "c", ":K_0_0", 1),
    connect("d", "c", ":K_1_0", 2),
]


def test_one_signal_may_stand_at_several_junctions(tmp_path: Path) -> None:
    roads = road_map(read_net(write(tmp_path, net=JOINED)), ["T"])
    assert roads.intersections[0].signal.conflicts == [(1, 2)]
    assert roads.centre == (25, 0, 0)
    assert set(roads.intersections[0].outline) == {(-9, -9), (59, -9), (59, 9), (-9, 9)}


def test_demand_goes_over_the_signal_and_on_as_far_as_asked(tmp_path: Path) -> None:
    net = read_net(write(tmp_path, net=JOINED))
    flows = movements(
        net,
        road_map(net, ["T"]).intersections[0].signal,
        TrafficConfig(demand_vph_per_lane={"d": 90}),
    )
    assert [(f.from_edge, f.to_edge, f.route, f.vph) for f in flows] == [
        ("a", "b", ["a", "b"], 500),
        ("b", "c", ["b", "c"], 500),
        ("d", "c", ["d", "c"], 90),
    ]


def test_nobody_turns_around_where_another_way_is_open(tmp_path: Path) -> None:
    around = [
        *(one.replace('state="yy"', 'state="yyy"').replace("{green}", "rGG") for one in CROSS),
        lane("back", "-10,3 -120,3"),
        lane(":J_3", "-10,0 -10,3"),
        connect("w", "back", ":J_3_0", 2),
        connect(":J_3", "back"),
    ]
    net = read_net(write(tmp_path, net=around))
    signal = road_map(net, ["T"]).intersections[0].signal
    flows = movements(net, signal, TrafficConfig())
    assert [(f.from_edge, f.to_edge) for f in flows] == [("s", "n"), ("w", "e")]
    only = [one for one in around if 'to="e"' not in one]
    net = read_net(write(tmp_path, net=[one.replace('"2"/>', '"1"/>') for one in only]))
    signal = road_map(net, ["T"]).intersections[0].signal
    assert ("w", "back") in [
        (f.from_edge, f.to_edge) for f in movements(net, signal, TrafficConfig())
    ]


def test_demand_for_an_edge_elsewhere_is_refused_with_those_allowed(tmp_path: Path) -> None:
    net = read_net(write(tmp_path))
    config = TrafficConfig(demand_vph_per_lane={"nowhere": 100})
    with pytest.raises(ConfigError, match=r"'nowhere'.*allowed: s, w"):
        movements(net, road_map(net, ["T"]).intersections[0].signal, config)


@pytest.mark.parametrize(
    ("body", "error_text"),
    [
        ("", "holds no lanes"),
        ("<edge", "cannot be read as XML"),
        ('<edge id="a"><lane id="a_0" shape="0,0 1,1"/></edge>', "not a valid SUMO net"),
        (lane("a", "0,0 1,1"), "no signal"),
    ],
)
def test_a_file_that_is_no_net_is_a_configuration_error(
    tmp_path: Path, body: str, error_text: str
) -> None:
    with pytest.raises(ConfigError, match=error_text):
        road_map(read_net(write(tmp_path, net=[body])), ["T"])


def test_a_missing_net_and_another_kind_of_file_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.net\.xml does not exist"):
        read_net(tmp_path / "none.net.xml")
    other = tmp_path / "routes.xml"
    other.write_text("<routes/>")
    with pytest.raises(ConfigError, match="<routes>, expected a SUMO <net>"):
        read_net(other)


def test_a_signal_that_the_net_lacks_is_refused_with_those_it_has(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no signal 'X'; cross\.net\.xml has: T$"):
        road_map(read_net(write(tmp_path)), ["X"])


@pytest.mark.parametrize(
    ("green", "error_text"), [("rr", "no phase of its plan is green"), ("rGr", "characters")]
)
def test_an_unfit_plan_is_a_configuration_error(
    tmp_path: Path, green: str, error_text: str
) -> None:
    with pytest.raises(ConfigError, match=error_text):
        road_map(read_net(write(tmp_path, green=green)), ["T"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('id="w"', 'id="w w"', "the edge id 'w w' has 3 characters, .* without spaces"),
        ('id="w_0"', 'id="w;0"', "the lane id 'w;0'"),
        ('id="w"', f'id="{"w" * 513}"', "has 513 characters, allowed are 1 to 512"),
        ('linkIndex="1"', 'linkIndex="-1"', "from w to e at signal T has the linkIndex -1"),
        (' linkIndex="1"', "", "from w to e at signal T has the linkIndex -1"),
        ('speed="13"', 'speed="nan"', "the number 'nan' is not finite"),
        ('shape="-120,0', 'shape="-inf,0', "the number '-inf' is not finite"),
        ('duration="30"', 'duration="1e999"', "the number '1e999' is not finite"),
        ('length="100"', "", "lacks 'length'"),
    ],
)
def test_what_sumo_or_a_message_would_not_take_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = write(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(
        ConfigError, match=rf"^net file {path} is not a valid SUMO net: .*{message}.*$"
    ):
        read_net(path)


def test_edges_of_names_too_long_for_a_vehicle_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, net=[part.replace('"w', '"' + "w" * 120) for part in CROSS])
    net = read_net(path)
    with pytest.raises(ConfigError, match="limit 118; rename the edges"):
        write_demand(
            tmp_path / "demand.rou.xml",
            net,
            road_map(net, ["T"]).intersections[0].signal,
            TrafficConfig(),
        )
