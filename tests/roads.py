"""Road maps that tests run on, each as small as its purpose allows."""

from collections.abc import Sequence

import numpy as np

from protocol.roadmap import Intersection, Lane, Link, PlanPhase, RoadMap, Signal

Point = tuple[float, float, float]
CENTRE = (0.0, 0.0, 0.0)


def lane(
    name: str,
    ends: Sequence[Point],
    *after: str,
    edge: str = "",
    width_m: float = 3.5,
    speed_mps: float = 13.9,
    length_m: float = 0.0,
) -> Lane:
    """Returns a lane along these points, as long as they lie apart; `:` begins an internal one."""
    points = np.array(ends)
    return Lane(
        id=name,
        edge=edge or name.rpartition("_")[0] or name,
        width_m=width_m,
        speed_mps=speed_mps,
        length_m=length_m or float(np.linalg.norm(points[-1] - points[0])),
        centreline=list(ends),
        successors=list(after),
        internal=name.startswith(":"),
    )


def signal(
    tls: str,
    *links: tuple[str, str],
    conflicts: Sequence[tuple[int, int]] = (),
    plan: Sequence[tuple[float, str]] = (),
) -> Signal:
    """Returns a signal of links (from lane, to lane) with a plan of (seconds, state)."""
    return Signal(
        tls=tls,
        links=[Link(index=n, from_lane=a, to_lane=b) for n, (a, b) in enumerate(links)],
        conflicts=list(conflicts),
        plan=[PlanPhase(duration_s=seconds, state=state) for seconds, state in plan],
    )


def one_junction(
    name: str,
    lanes: Sequence[Lane],
    signal: Signal,
    *,
    centre: Point = CENTRE,
    junction: Sequence[tuple[float, float]] = (),
) -> RoadMap:
    """Returns a map of lanes around one intersection with this outline."""
    one = Intersection(signal=signal, centre=centre, outline=list(junction))
    return RoadMap(name=name, lanes=list(lanes), intersections=[one])


def no_road(tls: str = "t", plan: Sequence[tuple[float, str]] = ()) -> RoadMap:
    """A signal without a lane."""
    return one_junction("none", [], signal(tls, plan=plan))


ONE_LANE = one_junction(
    name="one lane",
    centre=(0, 0, 0),
    lanes=[lane("in_0", [(-50, 0, 0), (0, 0, 0)], "out_0", speed_mps=13.89)],
    signal=signal("J", ("in_0", "out_0"), plan=[(30, "G"), (4, "y")]),
    junction=[(0, 0), (1, 0), (1, 1)],
)

MAIN_AND_SIDE = one_junction(
    name="test",
    centre=(0, 0, 0),
    lanes=[lane(name, [CENTRE, (120, 0, 0)], speed_mps=14) for name in ("main", "side", "out")],
    signal=signal(
        "j", ("main", "out"), ("side", "out"), conflicts=[(0, 1)], plan=[(30, "Gr"), (30, "rG")]
    ),
    junction=[],
)
"""A signal between two lanes that lead into a third."""

SQUARE: list[tuple[float, float]] = [(-10, -5), (10, -5), (10, 5), (-10, 5)]
WEST_TO_EAST = one_junction(
    name="t",
    centre=(0, 0, 0),
    lanes=[
        lane(name, ends, "east", width_m=3.2, speed_mps=14)
        for name, ends in {
            "west": [(-100, 0, 0), (-10, 0, 0)],
            "east": [(10, 0, 0), (100, 0, 0)],
        }.items()
    ],
    signal=signal("t", ("west", "east")),
    junction=SQUARE,
)


def _arm(name: str, start: tuple[float, float], end: tuple[float, float]) -> Lane:
    return lane(f"{name}_0", [(*start, 0), (*end, 0)], width_m=3.0, speed_mps=10)


CROSSING = one_junction(
    name="crossing",
    centre=(0, 0, 0),
    lanes=[
        _arm("south", (0, -80), (0, -5)),
        _arm("west", (-80, 0), (-5, 0)),
        _arm("north", (0, 5), (0, 80)),
        _arm("east", (5, 0), (80, 0)),
    ],
    signal=signal(
        "J",
        ("south_0", "north_0"),
        ("west_0", "east_0"),
        conflicts=[(0, 1)],
        plan=[(30, "Gr"), (30, "rG")],
    ),
    junction=[(-5, -5), (5, -5), (5, 5), (-5, 5)],
)


def straight_road() -> RoadMap:
    """A road along x: far (300 m), in (150 m), the junction (10 m), out (80 m), beyond (50 m)."""

    def part(name: str, start: float, end: float, *after: str) -> Lane:
        ends = [(start, 0, 0), (end, 0, 0)]
        return lane(name, ends, *after, edge=name, width_m=3.0, speed_mps=10)

    return one_junction(
        name="straight",
        centre=(0, 0, 0),
        lanes=[
            part("far", -455, -155, "in"),
            part("in", -155, -5, ":j"),
            part(":j", -5, 5, "out"),
            part("out", 5, 85, "beyond"),
            part("beyond", 85, 135),
        ],
        signal=signal("j", ("in", "out")),
        junction=[],
    )


def junction_road(climb: float = 0.0) -> RoadMap:
    """Two lanes from west to east through a junction at the origin, and one from the south.

    `far_0` opens into both lanes that end at the stop bar at x = -10; the road climbs by this
    much a metre from west to east.
    """

    def at(x: float, y: float) -> Point:
        return (x, y, climb * x)

    return one_junction(
        name="test",
        centre=CENTRE,
        lanes=[
            lane("far_0", [at(-310, 0), at(-160, 0)], "in_0", "in_1"),
            lane("in_0", [at(-160, -1.75), at(-10, -1.75)], ":j_0"),
            lane("in_1", [at(-160, 1.75), at(-10, 1.75)], ":j_1"),
            lane(":j_0", [at(-10, -1.75), at(10, -1.75)], "out_0"),
            lane(":j_1", [at(-10, 1.75), at(10, 1.75)], "out_1"),
            lane("out_0", [at(10, -1.75), at(160, -1.75)], "gone_0"),
            lane("out_1", [at(10, 1.75), at(160, 1.75)]),
            lane("gone_0", [at(160, -1.75), at(200, -1.75)]),
            lane("side_0", [at(1.75, -120), at(1.75, -10)], ":j_2"),
            lane(":j_2", [at(1.75, -10), at(4, -4), at(10, -1.75)], "out_0"),
        ],
        signal=signal(
            "j",
            ("in_0", "out_0"),
            ("in_1", "out_1"),
            ("side_0", "out_0"),
            conflicts=[(0, 2)],
            plan=[(30, "GGr"), (4, "yyr"), (20, "rrG"), (4, "rry")],
        ),
        junction=[(-10, -10), (10, -10), (10, 5), (-10, 5)],
    )


def street(climb_m: float = 0.0) -> RoadMap:
    """Two lanes either way along x, climbing eastwards, meet two lanes from the south."""
    lanes = []
    for k, y in enumerate((-1.75, -5.25)):
        lanes.append(_level(f"w_{k}", [(-160.0, y, -climb_m), (-10.0, y, -climb_m / 16)]))
        lanes.append(_level(f"e_{k}", [(10.0, y, climb_m / 16), (160.0, y, climb_m)]))
    for k, y in enumerate((1.75, 5.25)):
        lanes.append(_level(f"fe_{k}", [(160.0, y, climb_m), (10.0, y, climb_m / 16)]))
        lanes.append(_level(f"fw_{k}", [(-10.0, y, -climb_m / 16), (-160.0, y, -climb_m)]))
    for k, x in enumerate((-1.75, 1.75)):
        lanes.append(_level(f"s_{k}", [(x, -150.0, 0.0), (x, -10.0, 0.0)]))
    return one_junction(
        name="street",
        centre=CENTRE,
        lanes=lanes,
        signal=signal("t", ("w_0", "e_0"), ("fe_0", "fw_0"), ("s_0", "e_0"), conflicts=[(0, 2)]),
        junction=[(-10.0, -10.0), (10.0, -10.0), (10.0, 7.0), (-10.0, 7.0)],
    )


def _level(name: str, ends: Sequence[Point]) -> Lane:
    """Returns a lane whose length is measured in the plane, as SUMO does."""
    points = np.array(ends)
    return lane(name, ends, length_m=float(np.hypot(*(points[-1] - points[0])[:2])))


def bridge(high_m: float) -> RoadMap:
    """A level street along x with a signal, and a road along y, at x = 60, that passes over it."""
    level, up = street(), []
    rises = [(-300.0, 0.0), (-150.0, 0.0), (-60.0, high_m), (60.0, high_m), (150.0, 0.0)]
    rises.append((300.0, 0.0))
    for name, x, way in (("up_0", 61.75, rises), ("down_0", 58.25, rises[::-1])):
        up.append(_level(name, [(x, y, z) for y, z in way]))
    lanes = [one for one in level.lanes if not one.id.startswith("s_")]
    both = signal("t", ("w_0", "e_0"), ("fe_0", "fw_0"))
    return one_junction("bridge", [*lanes, *up], both)
