"""Where vehicles were seen, and where they were missed."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil

from protocol.errors import ConfigError
from protocol.messages import VehicleType
from protocol.roadmap import RoadMap
from recorder.run import Run
from recorder.tables import DetectionRow, TruthRow
from studies import palette
from studies.ecvpr import matches
from studies.of_run.clock import Clock
from studies.page.charts import MapChart, Mark, Points
from studies.page.model import Section, Text
from studies.reach import Reach
from studies.road_rings import road_rings

MOST_POINTS = 4000
_MARGIN_M = 8.0
_FRAMES = """
    SELECT frame FROM frames WHERE detections IS NOT NULL
    INTERSECT SELECT frame FROM truth ORDER BY frame
"""


@dataclass(slots=True)
class _Class:
    """Points of one class while they are gathered."""

    name: str
    colour: str
    mark: Mark = "disc"
    size: float = 4.5
    rows: list[tuple[float, float, str]] = field(default_factory=list)

    def points(self) -> Points:
        x_m, y_m, hover = zip(*self.rows, strict=True) if self.rows else ((), (), ())
        return Points(self.name, x_m, y_m, hover, self.size, self.mark, self.colour)


def places_section(run: Run, clock: Clock) -> Section:
    """Returns the map of a run, or why there is none."""
    title = "Where vehicles were seen and missed"
    try:
        setup = run.setup
    except ConfigError as error:
        return Section(title, (Text(f"There is no map: {error}."),))
    frames = [frame for (frame,) in run.query(_FRAMES)]
    if not frames:
        missing = "No frame has both truth and detections, so that the map shows the road alone."
        return Section(title, (Text(missing), _map(setup.road_map, _sensors(run), "")))
    kept = _thinned(run, frames)
    types = {kind.name: kind for kind in setup.vehicle_types}
    classes = _gathered(run, kept, clock, types, Reach(setup.road_map))
    points = [one.points() for one in classes if one.rows]
    notes = f"Vehicles within reach of the signal in {len(kept)} of {len(frames)} frames."
    return Section(title, (_map(setup.road_map, [*points, *_sensors(run)], notes),))


def _thinned(run: Run, frames: list[int]) -> list[int]:
    """Returns every n-th frame, so that about `MOST_POINTS` vehicles are shown."""
    ((vehicles,),) = run.query("SELECT count(*) FROM truth")
    return frames[:: max(1, ceil(vehicles / MOST_POINTS))]


def _gathered(
    run: Run, frames: list[int], clock: Clock, types: dict[str, VehicleType], reach: Reach
) -> list[_Class]:
    seen, own = _Class("detected", palette.GOOD), _Class("reports itself", palette.PLAIN)
    missed = _Class("missed", palette.BAD)
    nothing = _Class("detection of nothing", palette.INK, "cross", 6.0)
    for frame in frames:
        detections, when = run.of_frame(DetectionRow, frame), f"{clock[frame]:.1f} s"
        vehicles = run.of_frame(TruthRow, frame)
        found, false = matches(detections, vehicles, types)
        reporting = {one.source for one in detections}
        for one in vehicles:
            if reach.contains(one.lane, one.lane_position_m):
                kind = own if one.vehicle in reporting else seen if one.vehicle in found else missed
                kind.rows.append((one.x_m, one.y_m, f"{one.vehicle}, {when}"))
        nothing.rows += [(one.x_m, one.y_m, f"{one.source}, {when}") for one in false]
    return [seen, own, missed, nothing]


def _sensors(run: Run) -> list[Points]:
    """Returns where the roadside sensors stand."""
    centre = run.setup.road_map.centre
    mounts = run.scenario.get("roadside_mounts", [])
    places = [
        (centre[0] + float(one.get("x_m", 0)), centre[1] + float(one.get("y_m", 0)), str(one["id"]))
        for one in mounts
    ]
    if not places:
        return []
    x_m, y_m, names = zip(*places, strict=True)
    return [Points("roadside LiDAR", x_m, y_m, names, 13.0, "star", "#e69f00")]


def _map(road_map: RoadMap, points: list[Points], notes: str) -> MapChart:
    surfaces, lines = road_rings(road_map)
    return MapChart("From above", surfaces, lines, tuple(points), (), _window(points), notes)


def _window(points: list[Points]) -> tuple[float, float, float, float] | None:
    x_m = [x for one in points for x in one.x_m]
    y_m = [y for one in points for y in one.y_m]
    if len(x_m) < 2:
        return None
    return (
        min(x_m) - _MARGIN_M,
        min(y_m) - _MARGIN_M,
        max(x_m) + _MARGIN_M,
        max(y_m) + _MARGIN_M,
    )
