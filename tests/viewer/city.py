"""A setup with several junctions in two regions."""

from protocol.roadmap import Intersection, RoadMap
from tests.roads import CROSSING
from tests.viewer.shown import SETUP


def _shifted(junction: str, along_m: float) -> RoadMap:
    """The crossing with other names, so far to the east."""
    old = CROSSING.intersections[0]
    lanes = [
        lane.model_copy(
            update={
                "id": f"{junction}{lane.id}",
                "edge": f"{junction}{lane.edge}",
                "centreline": [(x + along_m, y, z) for x, y, z in lane.centreline],
                "tls": junction,
            }
        )
        for lane in CROSSING.lanes
    ]
    links = [
        link.model_copy(
            update={
                "from_lane": f"{junction}{link.from_lane}",
                "to_lane": f"{junction}{link.to_lane}",
            }
        )
        for link in old.signal.links
    ]
    signal = old.signal.model_copy(update={"tls": junction, "links": links})
    moved = Intersection(
        signal=signal,
        centre=(along_m, 0, 0),
        outline=[(x + along_m, y) for x, y in old.outline],
    )
    return RoadMap(name="shifted", lanes=lanes, intersections=[moved])


def _city() -> RoadMap:
    parts = [_shifted(tls, n * 200.0) for n, tls in enumerate(("J", "K", "L"))]
    return RoadMap(
        name="city",
        lanes=[lane for part in parts for lane in part.lanes],
        intersections=[one for part in parts for one in part.intersections],
    )


CITY_SETUP = SETUP.model_copy(
    update={
        "road_map": _city(),
        "scenario": SETUP.scenario | {"name": "city", "regions": {"r0": ["J", "K"], "r1": ["L"]}},
    }
)
"""Three crossings in a row, J and K in one region, L in another."""
