"""The section of a run's page about its junctions and regions: tables, and a map of the city."""

from __future__ import annotations

import numpy as np

from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from recording.run import Run
from sensing.config import Mount
from sensing.pose import mount_place
from studies import palette
from studies.by_region import Figures
from studies.outlines import ring, road_rings
from studies.page.model import (
    Block,
    Cell,
    Column,
    MapChart,
    Outlines,
    Points,
    Ring,
    Section,
    SideBySide,
    Table,
    Text,
)

_JUNCTION_COLUMNS = (
    Column("signal"),
    Column("region"),
    Column("E-CVPR, %", ".1f"),
    Column("delay, s", ".1f"),
    Column("phase switches", "d"),
    Column("count error, vehicles", ".2f"),
    Column("Mbit/s", ".2f"),
)
_REGION_COLUMNS = (
    Column("region"),
    Column("signals", "d"),
    Column("agents", ".1f"),
    Column("Mbit/s", ".2f"),
    Column("latency, ms", ".0f"),
    Column("handovers", "d"),
)
_CIRCLE_CORNERS = 48
_MARGIN_M = 40.0


def city_section(run: Run, junctions: Figures, regions: Figures) -> Section:
    """Returns the figures of each junction and region, and where they are.

    `junctions` and `regions` are those of the summary, `studies.by_region`.
    """
    members: dict[str, list[str]] = run.scenario.get("regions", {})
    tables = (_region_table(regions, members), _junction_table(junctions, members))
    blocks: list[Block] = [SideBySide(tables)]
    try:
        blocks.append(_map(run, run.setup.road_map, junctions, members))
    except ConfigError as error:
        blocks.append(Text(f"There is no map: {error}."))
    return Section("Junctions and regions", tuple(blocks))


def _junction_table(junctions: Figures, members: dict[str, list[str]]) -> Table:
    region_of = {tls: region for region, signals in members.items() for tls in signals}
    rows = tuple(
        (
            tls,
            region_of.get(tls),
            None if found["e_cvpr"] is None else 100 * found["e_cvpr"],
            found["delay_s"],
            found["switches"],
            found["count_error"],
            found["mbps"],
        )
        for tls, found in junctions.items()
    )
    notes = "By junction: delay is the mean of the vehicles on its lanes, count error of its lanes"
    return Table(_JUNCTION_COLUMNS, rows, notes)


def _region_table(regions: Figures, members: dict[str, list[str]]) -> Table:
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            region,
            len(members.get(region, ())),
            found["agents"],
            found["mbps"],
            found["latency_ms"],
            found["handovers"],
        )
        for region, found in regions.items()
    )
    return Table(_REGION_COLUMNS, rows, "By region: agents are the mean of frames, latency is p50")


def _map(
    run: Run, road_map: RoadMap, junctions: Figures, members: dict[str, list[str]]
) -> MapChart:
    surfaces, lines = road_rings(road_map)
    points = [
        _region_points(road_map, region, [tls for tls in own if tls in road_map.by_tls], junctions)
        for region, own in members.items()
    ]
    covered = _covered(run, road_map)
    return MapChart(
        "Signals by region, with the mean delay of a vehicle",
        surfaces,
        lines,
        tuple(one for one in points if one.x_m),
        (covered,) if covered.rings else (),
        map_window(road_map),
    )


def _region_points(
    road_map: RoadMap, region: str, signals: list[str], junctions: Figures
) -> Points:
    centres = [road_map.by_tls[tls].centre for tls in signals]
    delays = [junctions.get(tls, {}).get("delay_s") for tls in signals]
    labels = [
        tls if delay_s is None else f"{tls} {delay_s:.0f} s"
        for tls, delay_s in zip(signals, delays, strict=True)
    ]
    x_m, y_m = tuple(x for x, _, _ in centres), tuple(y for _, y, _ in centres)
    return Points(f"signals of {region}", x_m, y_m, 9.0, labels=tuple(labels))


def _covered(run: Run, road_map: RoadMap) -> Outlines:
    """Returns what roadside sensors cover at most: circles of the edge's coverage range."""
    range_m = float(run.scenario.get("edge", {}).get("coverage_range_m", 0.0))
    mounts = [Mount.model_validate(one) for one in run.scenario.get("roadside_mounts", [])]
    places = [mount_place(mount, road_map) for mount in mounts] if range_m > 0 else []
    rings = tuple(_circle(place[0], place[1], range_m) for place in places)
    return Outlines("range of a roadside LiDAR", rings, palette.QUIET)


def _circle(x_m: float, y_m: float, radius_m: float) -> Ring:
    turns_rad = np.linspace(0.0, 2 * np.pi, _CIRCLE_CORNERS, endpoint=False)
    around = np.column_stack([np.cos(turns_rad), np.sin(turns_rad)])
    return ring(radius_m * around + [x_m, y_m])


def map_window(road_map: RoadMap) -> tuple[float, float, float, float] | None:
    """Returns what a map shows of all roads: the lowest x and y in m, then the highest."""
    if not road_map.lanes:
        return None
    bounds = np.array([lane.bounds for lane in road_map.lanes])
    (left, low), (right, high) = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    return left - _MARGIN_M, low - _MARGIN_M, right + _MARGIN_M, high + _MARGIN_M
