"""The built-in T junction, after the one of Chen et al. 2022 (CARLA's Town04, signal 1368).

A main road with 4 lanes each way runs west-east; a side road with 2 lanes comes from the north,
one-way. Its left lane opens into all four lanes of the eastern exit, its right lane turns into the
western exit. The main road climbs gently at its eastern end. The junction's centre is (0, 0, 0).
"""

from __future__ import annotations

from pathlib import Path

from sim_host.plain import Row, write_plain_net, xml

TLS = "J"
SPEED_MPS = 13.89
LANE_WIDTH_M = 3.5
DEMAND_VPH_PER_LANE = {"north_in": 360.0}  # the paper's side road; 500 elsewhere
_CORNER_RADIUS_M = 12.0
_STOP_M = {"west": 19.0, "east": 12.0, "north": 26.0}  # where netconvert then puts the stop bars
_LENGTH_M = {"west": 193.0, "east": 237.0, "north": 431.0}  # of the approaches
_CLIMB_FROM_M, _CLIMB_M = 80.0, 2.0


def write_net(folder: Path) -> Path:
    """Writes `t_junction.net.xml` into the folder, by way of netconvert.

    Raises:
        ConfigError: netconvert is missing or fails.
    """
    parts = {"node": _nodes(), "edge": _edges(), "connection": _connections()}
    return write_plain_net(folder, "t_junction", parts, _signal_xml())


def _end_m(arm: str) -> float:
    return _STOP_M[arm] + _LENGTH_M[arm]


def _nodes() -> list[Row]:
    junction: Row = {"id": TLS, "x": 0, "y": 0, "z": 0, "type": "traffic_light", "tl": TLS}
    return [
        {**junction, "radius": _CORNER_RADIUS_M},
        {"id": "west", "x": -_end_m("west"), "y": 0, "z": 0},
        {"id": "east", "x": _end_m("east"), "y": 0, "z": _CLIMB_M},
        {"id": "north", "x": 0, "y": _end_m("north"), "z": 0},
    ]


def _edges() -> list[Row]:
    slope = [f"{_end_m('east')},0,{_CLIMB_M}", f"{_CLIMB_FROM_M},0,0", "0,0,0"]
    main: Row = {"numLanes": 4, "speed": SPEED_MPS, "width": LANE_WIDTH_M}
    east: Row = {**main, "id": "east_in", "from": "east", "to": TLS, "shape": " ".join(slope)}
    slope.reverse()
    return [
        {**main, "id": "west_in", "from": "west", "to": TLS},
        {**main, "id": "west_out", "from": TLS, "to": "west"},
        east,
        {**main, "id": "east_out", "from": TLS, "to": "east", "shape": " ".join(slope)},
        {**main, "id": "north_in", "from": "north", "to": TLS, "numLanes": 2},
    ]


def _connections() -> list[Row]:
    pairs = [("north_in", 0, "west_out", 0)]
    pairs += [("north_in", 1, "east_out", lane) for lane in range(4)]
    pairs += [("east_in", lane, "west_out", lane) for lane in range(4)]
    pairs += [("west_in", lane, "east_out", lane) for lane in range(4)]
    return [{"from": a, "fromLane": b, "to": c, "toLane": d} for a, b, c, d in pairs]


def _signal_xml() -> str:
    """The side road's five links come first, then the main road's eight."""
    phases = [
        (41, "rrrrrGGGGGGGG"),
        (4, "rrrrryyyyyyyy"),
        (1, "rrrrrrrrrrrrr"),
        (39, "GGGGGrrrrrrrr"),
        (4, "yyyyyrrrrrrrr"),
        (1, "rrrrrrrrrrrrr"),
    ]
    body = "".join(f'<phase duration="{s}" state="{state}"/>' for s, state in phases)
    links = [
        ("connection", {**row, "tl": TLS, "linkIndex": link})
        for link, row in enumerate(_connections())
    ]
    logic = f'<tlLogic id="{TLS}" type="static" programID="0" offset="0">{body}</tlLogic>'
    return xml("tlLogics", links, logic)
