"""A study's page compares the junctions of each of its networks, and shows where they are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cpnet import scenario as scenarios

pytest.importorskip("polars", reason="needs the extra `study`")
pytest.importorskip("distributed", reason="needs the extra `study`")

from studies.page.model import MapChart, Section, Table, Text, flattened
from studies.study_networks import network_sections
from studies.sweep.cells import Cell, ResultStore, cells_of
from studies.sweep.study_file import Study
from studies.sweep.worker import Outcome, Row, Rows

SIGNALS = ("A0", "B0", "C0", "D0", "E0")  # of the network corridor
CONTROLLERS = {"fixed": {"signal.policy": "fixed"}, "pressure": {"signal.policy": "max_pressure"}}


@pytest.fixture
def store(tmp_path: Path) -> ResultStore:
    return ResultStore.at(tmp_path / "out")


def cells(axes: dict[str, Any], seeds: tuple[int, ...] = (1, 2)) -> list[Cell]:
    data = {"name": "s", "seeds": seeds, "set": {"mode": "lockstep"}, "axes": axes}

    def resolve(keys: dict[str, Any]) -> dict[str, Any]:
        return scenarios.load("t_junction", keys).model_dump(mode="json")

    return cells_of(Study.model_validate(data), resolve)


def junctions(cell: Cell) -> Rows:
    """Returns delays from 5 s, 20 s more at each signal; 1 s more with each seed."""
    if cell.scenario["traffic"]["network"] == "t_junction":
        return {"gneJ1": figures(5.0)}
    if cell.scenario["traffic"]["network"] == "grid":
        return {f"{a}{b}": figures(1.0) for a in "AB" for b in "01"}
    return {tls: figures(5.0 + 20 * n + cell.seed) for n, tls in enumerate(SIGNALS)}


def figures(delay_s: float) -> Row:
    return {"region": "r0", "e_cvpr": 0.5, "delay_s": delay_s, "switches": 3, "mbps": 1.0}


def sections(
    cells: list[Cell], store: ResultStore, found: Callable[[Cell], Rows] = junctions
) -> list[Section]:
    for cell in cells:
        regions: Rows = {
            region: {"agents": 4.0, "mbps": 2.5, "handovers": 1} for region in ("r0", "r1")
        }
        store.save(cell, Outcome({"frames": 1}, 1.0, found(cell), regions))
    return [*network_sections(cells, store)]


def tables(section: Section) -> dict[str, Table]:
    found = [block for block in flattened(section.blocks) if isinstance(block, Table)]
    return {f"{table.columns[0].name}: {table.caption}": table for table in found}


def test_controllers_stand_beside_each_other_for_each_junction(store: ResultStore) -> None:
    axes = {"traffic.network": ["t_junction", "corridor"], "controller": CONTROLLERS}
    (section,) = sections(cells(axes), store)
    assert section.title == "Junctions of all, corridor"
    found = tables(section)
    delays = found["signal: Mean delay, s"]
    assert [column.name for column in delays.columns] == ["signal", "fixed", "pressure"]
    assert [row[0] for row in delays.rows] == [*SIGNALS]
    assert delays.rows[1] == ("B0", "26.5 (26.0, 27.0)", "26.5 (26.0, 27.0)")
    assert found["signal: E-CVPR, %"].rows[0][1] == "50.0 (50.0, 50.0)"
    assert found["signal: Uplink, Mbit/s"].rows[0][1] == "1.00 (1.00, 1.00)"
    assert "signal: Error of a lane's count, vehicles" not in found  # none was measured
    assert found["region: Handovers"].rows == (
        ("r0", "1 (1, 1)", "1 (1, 1)"),
        ("r1", "1 (1, 1)", "1 (1, 1)"),
    )


def test_a_map_for_each_controller_shows_the_level_of_each_delay(store: ResultStore) -> None:
    (section,) = sections(
        cells({"traffic.network": ["corridor"], "controller": CONTROLLERS}), store
    )
    maps = [one for one in flattened(section.blocks) if isinstance(one, MapChart)]
    assert [one.title for one in maps] == ["Mean delay: fixed", "Mean delay: pressure"]
    shown = [(points.name, points.labels) for points in maps[0].points]
    assert shown == [
        ("0 to 10 s", ("A0 6 s",)), ("20 to 35 s", ("B0 26 s",)), ("35 to 55 s", ("C0 46 s",)),
        ("55 to 80 s", ("D0 66 s",)), ("more than 80 s", ("E0 86 s",)),
    ]  # fmt: skip
    east = [x_m for points in maps[0].points for x_m in points.x_m]
    assert east == sorted(east)
    assert maps[0].surfaces


def test_each_network_has_a_section_of_its_own(store: ResultStore) -> None:
    axes = {"net": {"small": {"traffic.network": "grid", "traffic.grid_size": 2},
                    "long": {"traffic.network": "corridor"}}}  # fmt: skip
    found = sections(cells(axes, seeds=(1,)), store)
    assert [one.title for one in found] == ["Junctions of all, small", "Junctions of all, long"]
    together = tables(found[0])["signal: "]
    assert [column.name for column in together.columns] == [
        "signal", "mean delay, s", "E-CVPR, %", "phase switches", "uplink, Mbit/s",
    ]  # fmt: skip
    assert [row[:3] for row in together.rows] == [
        (tls, "1.0", "50.0") for tls in ("A0", "A1", "B0", "B1")
    ]


def test_numbers_are_labels_too_and_what_is_too_much_for_a_table_is_said(
    store: ResultStore,
) -> None:
    rates = [n / 10 for n in range(8)]
    axes = {"traffic.network": ["corridor"], "traffic.cav_rate": rates}
    (section,) = sections(cells(axes, seeds=(1,)), store)
    names = [column.name for column in tables(section)["signal: Mean delay, s"].columns]
    assert names == ["signal", "0", "0.1", "0.2", "0.3", "0.4", "0.5"]
    assert isinstance(section.blocks[0], Text)
    assert "2 further combinations" in section.blocks[0].text


def test_a_junction_without_vehicles_is_shown_as_such(store: ResultStore) -> None:
    def empty(cell: Cell) -> Rows:
        return junctions(cell) | {"C0": {"region": "r0", "delay_s": None}}

    (section,) = sections(cells({"traffic.network": ["corridor"]}), store, empty)
    assert set(tables(section)["signal: "].rows[2][1:]) == {None}
    (city,) = [one for one in section.blocks if isinstance(one, MapChart)]
    assert ("no vehicle", ("C0 –",)) in [(points.name, points.labels) for points in city.points]


def test_a_net_that_is_gone_has_tables_but_no_map(store: ResultStore, tmp_path: Path) -> None:
    net = tmp_path / "own.net.xml"
    net.write_text("<net/>")
    listed = cells({"traffic.net": [str(net)]})
    (section,) = sections(listed, store, lambda _: {tls: figures(5.0) for tls in SIGNALS})
    assert tables(section)
    assert any(isinstance(one, Text) and "There is no map" in one.text for one in section.blocks)


def test_studies_of_single_junctions_have_no_such_section(store: ResultStore) -> None:
    assert sections(cells({"controller": CONTROLLERS}), store) == []
