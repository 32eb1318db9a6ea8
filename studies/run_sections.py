"""Sections of a run's page: vehicle counts, signal phases, map of detected and missed vehicles."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import replace
from itertools import groupby
from math import ceil

import numpy as np

from protocol.errors import ConfigError
from protocol.messages import VehicleType
from protocol.roadmap import RoadMap, Signal
from recording.run import Run
from recording.tables import CountRow, DetectionRow, PhaseRow, RequestRow, TruthRow
from sensing.config import Mount
from sensing.pose import mount_place
from studies import palette
from studies.count_error import counts_with_truth
from studies.ecvpr import EvaluationArea, FrameScore, matches, parked_bodies
from studies.outlines import road_rings
from studies.over_time import TIME, FrameClock, over_time, thinned_series
from studies.page.model import (
    Block,
    Chart,
    Column,
    MapChart,
    Mark,
    Points,
    Section,
    SideBySide,
    Span,
    Table,
    Text,
    Timeline,
)

Counted = list[tuple[CountRow, int | None]]
_COLUMNS = (
    Column("lane"),
    Column("side"),
    Column("counted", ".2f"),
    Column("present", ".2f"),
    Column("mean error", "+.2f"),
    Column("mean absolute error", ".2f"),
)


def vehicles_section(run: Run, clock: FrameClock, scores: list[FrameScore]) -> Section:
    """Returns counts and E-CVPR over time, and counts by lane."""
    counted = _counted(run)
    blocks: list[Block] = []
    charts = [_over_time(counted, clock)] if counted else []
    if scores:
        charts.append(_rate(scores, clock))
    else:
        blocks.append(Text("There is no truth to compare with, or no frame that was perceived."))
    if charts:
        blocks.append(SideBySide(tuple(charts)))
    blocks.append(_by_lane(counted) if counted else Text("No lane counts were recorded."))
    return Section("Vehicles", tuple(blocks))


def _counted(run: Run) -> Counted:
    """Returns all counts, with the truth where there is one."""
    try:
        found: Counted = list(counts_with_truth(run))
    except ConfigError:  # without its setup, or of a scenario that this version does not know
        found = []
    return found or [(row, None) for row in run.rows(CountRow)]


def _over_time(counted: Counted, clock: FrameClock) -> Chart:
    frames: dict[int, list[float]] = defaultdict(lambda: [0.0, 0.0])
    for row, present in counted:
        sums = frames[row.frame]
        sums[0] += row.vehicles
        sums[1] += np.nan if present is None else present
    x = [clock[frame] for frame in frames]
    series = [thinned_series("counted", x, [sums[0] for sums in frames.values()], palette.PLAIN)]
    there = [sums[1] for sums in frames.values()]
    if not np.isnan(there).all():
        series.insert(0, thinned_series("present", x, there, palette.QUIET))
    return over_time("Vehicles on the counted lanes", "vehicles", tuple(series))


def _rate(scores: list[FrameScore], clock: FrameClock) -> Chart:
    x = [clock[one.frame] for one in scores]
    shares = {
        "detected or coasting": [one.e_cvpr for one in scores],
        "visible": [one.visible_share for one in scores],
    }
    colours = {"detected or coasting": palette.GOOD, "visible": palette.QUIET}
    series = tuple(
        thinned_series(
            name, x, [None if share is None else 100 * share for share in values], colours[name]
        )
        for name, values in shares.items()
        if any(share is not None for share in values)
    )
    return over_time("Vehicles near the signal that were detected (E-CVPR)", "%", series)


def _by_lane(counted: Counted) -> Table:
    lanes: dict[tuple[str, str], list[tuple[int, int | None]]] = defaultdict(list)
    for row, present in counted:
        lanes[row.side, row.lane].append((row.vehicles, present))
    rows = tuple(
        (lane, side, *_means(pairs))
        for (side, lane), pairs in sorted(
            lanes.items(), key=lambda one: (one[0][0] != "upstream", one[0])
        )
    )
    return Table(_COLUMNS, rows, "By lane, mean over frames")


def _means(pairs: list[tuple[int, int | None]]) -> tuple[float | None, ...]:
    mean = float(np.mean([counted for counted, _ in pairs]))
    known = np.array([pair for pair in pairs if pair[1] is not None], np.float64).reshape(-1, 2)
    if not len(known):
        return mean, None, None, None
    error = known[:, 0] - known[:, 1]
    return mean, float(known[:, 1].mean()), float(error.mean()), float(np.abs(error).mean())


MAX_PRESSURES = 6  # charts
_LONGEST = 28  # letters of a phase's name
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


class PhaseNames:
    """Names of a signal's phases: a letter and the edges with green; the plan's come first."""

    def __init__(self, signal: Signal | None) -> None:
        self._signal = signal
        self.greens = self._signal.greens if self._signal else []

    def __getitem__(self, green: str) -> str:
        """Returns the name of a green state; one that the plan lacks takes the next letter."""
        if green not in self.greens:
            self.greens.append(green)
        number = self.greens.index(green)
        letter = _LETTERS[number] if number < len(_LETTERS) else str(number)
        return f"{letter}: {self._edges(green)}"

    def _edges(self, green: str) -> str:
        links = self._signal.links if self._signal else []
        lanes = [k.from_lane for k in links if k.index < len(green) and green[k.index] in "Gg"]
        edges = ", ".join(dict.fromkeys(lane.rpartition("_")[0] or lane for lane in lanes))
        text = edges or green
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def _phase_names(run: Run) -> dict[str, PhaseNames]:
    """Returns the names of each signal's phases, by its id."""
    try:
        known = run.setup.road_map.by_tls
    except ConfigError:  # cut off before its setup was written, or moved without it
        known = {}
    found = {tls for (tls,) in run.query("SELECT tls FROM phases UNION SELECT tls FROM requests")}
    return {tls: PhaseNames(known[tls].signal if tls in known else None) for tls in sorted(found)}


def phases_section(run: Run, clock: FrameClock) -> Section:
    """Returns phases over time, and pressures, of each signal."""
    names = _phase_names(run)
    blocks: list[Block] = []
    spans = _spans(list(run.rows(PhaseRow)), names, clock)
    if spans:
        rows = tuple(sorted(dict.fromkeys(span.row for span in spans)))
        blocks.append(Timeline("Phases", TIME, rows, tuple(spans), palette.LAMPS))
    else:
        blocks.append(Text("No signal state was recorded."))
    pressures = _pressures(run, names, clock)
    if not pressures:
        blocks.append(Text("No pressures were recorded: the policy does not weigh any."))
    elif len(pressures) > MAX_PRESSURES:
        blocks.append(Text(f"Pressures are drawn of {MAX_PRESSURES} signals at most."))
    else:
        blocks += pressures
    return Section("Signal", tuple(blocks))


def _spans(rows: list[PhaseRow], names: dict[str, PhaseNames], clock: FrameClock) -> list[Span]:
    """Returns how long each stage lasted, of all signals."""
    rows = sorted(rows, key=lambda row: (row.tls, row.frame))
    spans: list[Span] = []
    for tls, shown in groupby(rows, key=lambda row: row.tls):
        prefix = f"{tls} " if len(names) > 1 else ""
        spans += _of_signal(list(shown), names[tls], clock, prefix)
    return spans


def _of_signal(
    rows: list[PhaseRow], names: PhaseNames, clock: FrameClock, prefix: str
) -> list[Span]:
    """Returns one signal's stages; yellow and all-red belong to the green before them."""
    spans: list[Span] = []
    present = ""
    for (stage, green), group in groupby(rows, key=lambda row: (row.stage, row.green)):
        first = next(group)
        if stage == "green" or not present:
            present = green
        start_s = clock[first.frame]
        if spans:
            spans[-1] = replace(spans[-1], end=start_s)
        row = prefix + names[present]
        spans.append(Span(row, start_s, start_s, stage.replace("_", " ")))
    if spans:
        spans[-1] = replace(spans[-1], end=clock[rows[-1].frame] + clock.period_s)
    return spans


def _pressures(run: Run, names: dict[str, PhaseNames], clock: FrameClock) -> list[Chart]:
    """Returns a chart of each signal whose policy weighs its phases."""
    x: dict[str, list[float]] = defaultdict(list)
    tables: dict[str, list[list[float]]] = defaultdict(list)
    for row in run.rows(RequestRow):
        values = _parsed(row.pressures)
        if values and len(values) == len(names[row.tls].greens):
            x[row.tls].append(clock[row.frame])
            tables[row.tls].append(values)
    return [
        _pressures_of(names[tls], x[tls], tables[tls], f" of {tls}" if len(names) > 1 else "")
        for tls in sorted(tables)
    ]


def _pressures_of(
    names: PhaseNames, x: list[float], table: list[list[float]], of_signal: str
) -> Chart:
    series = tuple(
        thinned_series(names[green], x, [values[i] for values in table])
        for i, green in enumerate(names.greens)
    )
    return over_time(f"Pressure of each phase{of_signal}", "vehicles", series, kind="steps")


def _parsed(text: str) -> list[float]:
    try:
        values = json.loads(text)
    except ValueError:
        return []
    is_list = isinstance(values, list) and all(isinstance(v, int | float) for v in values)
    return [float(v) for v in values] if is_list else []


MAX_POINTS = 4000
_MARGIN_M = 8.0
_CLASSES: tuple[tuple[str, float, Mark, str], ...] = (
    ("missed", 4.5, "disc", palette.BAD),
    ("coasting", 4.5, "disc", palette.QUIET),
    ("detected", 4.5, "disc", palette.GOOD),
    ("reports itself", 4.5, "disc", palette.PLAIN),
    ("false detection", 6.0, "cross", palette.INK),
)
"""Layers of the map, from below: missed vehicles do not hide detected ones."""
_FRAMES = """
    SELECT frame FROM frames WHERE detections IS NOT NULL
    INTERSECT SELECT frame FROM truth ORDER BY frame
"""


def map_section(run: Run) -> Section:
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
    points = _vehicle_points(run, kept, types, EvaluationArea(setup.road_map))
    notes = f"Vehicles near the signal in {len(kept)} of {len(frames)} frames."
    return Section(title, (_map(setup.road_map, [*points, *_sensors(run)], notes),))


def _thinned(run: Run, frames: list[int]) -> list[int]:
    """Returns every n-th frame, so that about `MAX_POINTS` vehicles are shown."""
    ((vehicles,),) = run.query("SELECT count(*) FROM truth")
    return frames[:: max(1, ceil(vehicles / MAX_POINTS))]


def _vehicle_points(
    run: Run, frames: list[int], types: dict[str, VehicleType], area: EvaluationArea
) -> list[Points]:
    """Returns where vehicles were detected, coasted, reported themselves or were missed."""
    classes: dict[str, list[tuple[float, float]]] = defaultdict(list)
    parked = parked_bodies(run.setup)
    for frame in frames:
        detections, vehicles = run.of_frame(DetectionRow, frame), run.of_frame(TruthRow, frame)
        found, false = matches(detections, vehicles + parked, types)
        observed = [one for one in detections if one.coasted_s == 0]
        seen, _ = matches(observed, vehicles + parked, types)
        reporting = {one.source for one in detections}
        for one in vehicles:
            if area.contains(one.lane, one.lane_position_m):
                known = "coasting" if one.vehicle in found else "missed"
                detected = "detected" if one.vehicle in seen else known
                name = "reports itself" if one.vehicle in reporting else detected
                classes[name].append((one.x_m, one.y_m))
        classes["false detection"] += [(one.x_m, one.y_m) for one in false]
    points: list[Points] = []
    for name, size, mark, colour in _CLASSES:
        x_m, y_m = tuple(x for x, _ in classes[name]), tuple(y for _, y in classes[name])
        points += [Points(name, x_m, y_m, size, mark, colour)] if x_m else []
    return points


def _sensors(run: Run) -> list[Points]:
    """Returns the positions of the roadside sensors."""
    mounts = [Mount.model_validate(one) for one in run.scenario.get("roadside_mounts", [])]
    places = [mount_place(mount, run.setup.road_map) for mount in mounts]
    x_m, y_m = (tuple(place[axis] for place in places) for axis in (0, 1))
    return [Points("roadside LiDAR", x_m, y_m, 13.0, "star", "#e69f00")] if mounts else []


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
