"""The sections of a study's page about networks of several junctions: their figures, and maps."""

from __future__ import annotations

import json
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from sim_host.setup import build_setup
from studies import palette
from studies.city_section import map_window
from studies.outlines import road_rings
from studies.page.model import (
    DASH,
    Block,
    Column,
    MapChart,
    Points,
    Section,
    SideBySide,
    Table,
    Text,
)
from studies.study_tables import (
    CAPTION,
    COUNT_ERROR,
    DELAY,
    E_CVPR,
    GridRow,
    Measure,
    figure_of,
    label_of,
    mean_of,
)
from studies.sweep.cells import Cell, ResultStore, Scenario
from studies.sweep.results import over_seeds, parts_table
from studies.sweep.study_file import Label

MIN_JUNCTIONS = 2
MAX_COMBINATIONS = 6  # of a grid's axes, in a table beside each other
_MAX_MAPS = 4
_MAX_NAME = 10  # letters of a signal's id on a map
_ROADS = ("network", "grid_size", "net", "sumocfg")  # of `traffic`: which net it is
_LOAD = Measure("mbps", "uplink, Mbit/s", 1, 2)
_SWITCHES = Measure("switches", "phase switches", 1, 0)
_SHOWN = (DELAY, E_CVPR, COUNT_ERROR, _SWITCHES, _LOAD)
_REGION_SHOWN = (
    Measure("agents", "agents", 1, 1),
    _LOAD,
    Measure("handovers", "handovers", 1, 0),
)
_LEVELS_S = (10, 20, 35, 55, 80)
"""Mean delays that bound the levels of service A to F of signals: Highway Capacity Manual 2010."""


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """A net of several junctions in one of a study's grids, and the combinations run on it.

    `title` says which net of the grid it is; `combinations` are labels by axis, by their names.
    """

    grid: str
    title: str
    scenario: Scenario
    combinations: dict[str, dict[str, Label]]


def network_sections(cells: list[Cell], store: ResultStore) -> tuple[Section, ...]:
    """Returns a section for each net of several junctions in each grid; none without such nets."""
    networks = networks_of(cells, store)
    if not networks:
        return ()
    junctions = parts_table(cells, store, "junctions")
    regions = parts_table(cells, store, "regions")
    return tuple(_section(network, junctions, regions) for network in networks)


def networks_of(cells: list[Cell], store: ResultStore) -> list[Network]:
    """Returns the nets with several junctions on which finished cells were run."""
    groups: dict[str, dict[str, list[Cell]]] = defaultdict(lambda: defaultdict(list))
    for cell in cells:
        signals = store.parts(cell.id, "junctions") or {}
        if len(signals) >= MIN_JUNCTIONS:
            roads = [cell.scenario["traffic"].get(key) for key in _ROADS]
            groups[cell.grid][json.dumps([roads, sorted(signals)])].append(cell)
    return [
        _network(members, [cell for cell in cells if cell.grid == grid])
        for grid, nets in groups.items()
        for members in nets.values()
    ]


def _network(members: list[Cell], grid: list[Cell]) -> Network:
    """Names a net by the labels that only its cells have, its combinations by the other axes."""
    axes = list(members[0].labels)
    shared = [axis for axis in axes if len({cell.labels[axis] for cell in members}) == 1]
    varied = [axis for axis in axes if axis not in shared]
    own = [axis for axis in shared if len({cell.labels[axis] for cell in grid}) > 1]
    title = ", ".join([members[0].grid, *(label_of(members[0].labels[axis]) for axis in own)])
    combinations = {
        ", ".join(label_of(cell.labels[axis]) for axis in varied) or "mean": cell.labels
        for cell in members
    }
    return Network(members[0].grid, title, members[0].scenario, combinations)


def _section(network: Network, junctions: pl.DataFrame, regions: pl.DataFrame) -> Section:
    found = _by_part(network, junctions, "tls", _SHOWN)
    by_region = _by_part(network, regions, "region", _REGION_SHOWN)
    blocks: list[Block] = [Text(_introduction(network)), *_tables(found, "signal", _SHOWN)]
    blocks += _maps(network, found)
    if any(len(rows) > 1 for rows in by_region.values()):
        blocks += _tables(by_region, "region", _REGION_SHOWN)
    return Section(f"Junctions of {network.title}", tuple(blocks))


def _introduction(network: Network) -> str:
    text = (
        f"{CAPTION} A junction's delay is "
        "the mean of the vehicles on its lanes, its uplink that of the CAVs on them and of its "
        "roadside LiDARs."
    )
    left_out = len(network.combinations) - MAX_COMBINATIONS
    if left_out > 0:
        text += f" {left_out} further combinations are in junctions.parquet only."
    return text


Found = dict[str, dict[str, GridRow]]
"""Figures over seeds, by the name of a combination and by junction or region."""


def _by_part(network: Network, frame: pl.DataFrame, part: str, shown: tuple[Measure, ...]) -> Found:
    found: Found = {}
    for name, labels in list(network.combinations.items())[:MAX_COMBINATIONS]:
        own = frame.filter(grid=network.grid)
        for axis, label in labels.items():
            own = own.filter(
                pl.col(axis) == (str(label) if own[axis].dtype == pl.String else label)
            )
        values = [one.value for one in shown if one.value in own.columns]
        found[name] = {row[part]: row for row in over_seeds(own, [part], values).to_dicts()}
    return found


def _tables(found: Found, part: str, shown: tuple[Measure, ...]) -> list[Table]:
    """Returns a table for each measure, or one of all measures if there is one combination."""
    names = list(dict.fromkeys(name for rows in found.values() for name in rows))
    rows = [row for by_name in found.values() for row in by_name.values()]
    used = [
        one for one in shown if any(figure_of(r, f"{one.value}_mean") is not None for r in rows)
    ]

    def table(cells: list[tuple[str, str, Measure]], caption: str) -> Table:
        columns = (Column(part), *(Column(head) for head, _, _ in cells))
        lines = (
            (name, *(mean_of(found[own].get(name, {}), one) for _, own, one in cells))
            for name in names
        )
        return Table(columns, tuple(lines), caption)

    if len(found) == 1:
        return [table([(one.name, own, one) for own in found for one in used], "")]
    return [
        table([(own, own, one) for own in found], one.name[:1].upper() + one.name[1:])
        for one in used
    ]


def _maps(network: Network, found: Found) -> list[Block]:
    try:
        with tempfile.TemporaryDirectory(prefix="cpnet-net-") as folder:
            roads = build_setup(network.scenario, Path(folder)).road_map
    except ConfigError as error:  # its files have changed since its cells were run
        return [Text(f"There is no map: {error}.")]
    surfaces, lines = road_rings(roads)
    charts = [
        MapChart(
            f"Mean delay: {name}" if len(found) > 1 else "Mean delay",
            surfaces,
            lines,
            _levels(roads, rows),
            window=map_window(roads),
        )
        for name, rows in list(found.items())[:_MAX_MAPS]
    ]
    return [SideBySide(tuple(charts))] if len(charts) > 1 else [*charts]


def _levels(roads: RoadMap, rows: dict[str, GridRow]) -> tuple[Points, ...]:
    """Returns the signals by their level of service."""
    members: dict[int, list[tuple[float, float, str]]] = defaultdict(list)
    for one in roads.intersections:
        delay_s = figure_of(rows.get(one.tls, {}), "delay_s_mean")
        name = one.tls if len(one.tls) <= _MAX_NAME else f"{one.tls[: _MAX_NAME - 1]}…"
        label = f"{name} {DASH if delay_s is None else f'{delay_s:.0f} s'}"
        level = -1 if delay_s is None else sum(delay_s > bound_s for bound_s in _LEVELS_S)
        members[level].append((one.centre[0], one.centre[1], label))
    return tuple(_level(level, members[level]) for level in sorted(members))


def _level(level: int, members: list[tuple[float, float, str]]) -> Points:
    x_m, y_m, labels = zip(*members, strict=True)
    if level < 0:
        return Points("no vehicle", x_m, y_m, 9.0, colour=palette.QUIET, labels=labels)
    bounds = (0, *_LEVELS_S)
    until = (
        f"{bounds[level]} to {bounds[level + 1]} s"
        if level < len(_LEVELS_S)
        else f"more than {_LEVELS_S[-1]} s"
    )
    return Points(until, x_m, y_m, 9.0, colour=palette.LEVELS[level], labels=labels)
