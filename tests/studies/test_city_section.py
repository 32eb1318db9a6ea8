"""The page of a run with several junctions compares them, and shows where they are."""

import json
from pathlib import Path
from typing import Any

import pytest

from protocol.wire import encode
from recording.database import Database
from recording.run import SETUP_NAME
from recording.tables import (
    FrameRow,
    MetaRow,
    PhaseRow,
    RegionFrameRow,
    RequestRow,
    TruthRow,
    UploadRow,
)  # fmt: skip
from studies import ecvpr
from studies.ecvpr import FrameScore, score_frame
from studies.page.model import Chart, Colours, MapChart, Page, Table, Timeline, flattened
from studies.run_page import run_page
from tests.viewer.city import CITY_SETUP
from tests.viewer.shown import CAR, SETUP

MS = 1_000_000
REGIONS = CITY_SETUP.scenario["regions"]
SECTION = "Junctions and regions"


@pytest.fixture
def page(tmp_path: Path) -> Page:
    """Of three crossings, K and L switch once; a car stands before L."""
    setup = CITY_SETUP.model_copy(update={"vehicle_types": [CAR]})
    (tmp_path / SETUP_NAME).write_bytes(encode(setup))
    database = Database(tmp_path)
    scenario = {
        "name": "city", "frame_period_s": 0.1, "regions": REGIONS,
        "roadside_mounts": [{"id": "rsu", "tls": "L", "x_m": 0, "y_m": 0}],
        "edge": {"coverage_range_m": 50.0},
    }  # fmt: skip
    database.add(MetaRow, [("scenario", json.dumps(scenario)), ("end_reason", "finished")])
    for n in range(10):
        ns = n * 100 * MS
        database.add(FrameRow, [FrameRow(n, ns, 1, 0, 0, 1, 9, 0, 1, ns, ns, 40 * MS)])
        for agents, region in enumerate(REGIONS, start=1):
            took_ns = agents * 10 * MS
            row = RegionFrameRow(n, region, agents, 9, 0, 1, 0, ns, took_ns)
            database.add(RegionFrameRow, [row])
            stamps = (ns, ns, ns, ns, None, ns, ns)
            database.add(UploadRow, [UploadRow(n, region, "rsu", 0, 9, 1250, None, None, *stamps)])
        car = TruthRow(n, "v", "car", 0, 400, -20, 0, 0, 0, 0, 0, "Lsouth_0", 60)
        database.add(TruthRow, [car])
        for tls in "JKL":
            green = "Gr" if tls == "J" or n < 5 else "rG"
            database.add(PhaseRow, [PhaseRow(n, tls, ns, green, "green", green, "max_pressure")])
            pressures = f"[{ord(tls)}.0, 0.0]"
            database.add(
                RequestRow, [RequestRow(n, tls, green, "max_pressure", pressures, None, "", 0)]
            )
    database.close()
    return run_page(tmp_path)


def tables(page: Page) -> dict[str, list[tuple[object, ...]]]:
    (section,) = (one for one in page.sections if one.title == SECTION)
    found = [block for block in flattened(section.blocks) if isinstance(block, Table)]
    return {table.columns[0].name: [*table.rows] for table in found}


def test_junctions_and_regions_are_compared_in_tables(page: Page) -> None:
    rows = {str(row[0]): row[1:] for row in tables(page)["signal"]}
    assert [rows[tls][0] for tls in "JKL"] == ["r0", "r0", "r1"]
    assert rows["L"][2] == pytest.approx(1.0)  # the car stands all the time
    assert [rows[tls][3] for tls in "JKL"] == [0, 1, 1]
    assert [rows[tls][5] for tls in "JKL"] == [0, 0, pytest.approx(0.2)]  # the post's, to both
    regions = {row[0]: row[1:] for row in tables(page)["region"]}
    assert regions["r0"] == (2, 1.0, pytest.approx(0.1), 10.0, 0)
    assert regions["r1"] == (1, 2.0, pytest.approx(0.1), 20.0, 0)


def test_the_map_names_all_signals_in_their_regions(page: Page) -> None:
    city = next(one for one in page.figures() if isinstance(one, MapChart))
    points = {one.name: one for one in city.points}
    assert points["signals of r0"].labels == ("J", "K")
    assert points["signals of r1"].labels == ("L 1 s",)
    assert points["signals of r1"].x_m == (400,)
    (covered,) = city.outlines
    assert max(x for x, _ in covered.rings[0]) == pytest.approx(450, abs=0.5)
    assert city.window is not None
    left, _, right, _ = city.window
    assert (left, right) == (-120, 520)


def test_each_signal_has_phases_and_pressures_of_its_own(page: Page) -> None:
    (lamps,) = (one for one in page.figures() if isinstance(one, Timeline))
    assert lamps.rows == ("J A: Jsouth", "K A: Ksouth", "K B: Kwest", "L A: Lsouth", "L B: Lwest")
    charts = [one for one in page.figures() if isinstance(one, Chart)]
    drawn = {one.title: one.series for one in charts if one.title.startswith("Pressure")}
    assert [*drawn] == [f"Pressure of each phase of {tls}" for tls in "JKL"]
    assert [series.name for series in drawn["Pressure of each phase of K"]] == [
        "A: Ksouth",
        "B: Kwest",
    ]
    assert set(drawn["Pressure of each phase of L"][0].y) == {float(ord("L"))}


def test_labels_are_drawn_at_their_points(page: Page) -> None:
    figure = pytest.importorskip("matplotlib.figure", reason="extra study")
    from studies.page.plotting import draw_map

    city = next(one for one in page.figures() if isinstance(one, MapChart))
    axes = figure.Figure().subplots()
    draw_map(city, axes, Colours.of(page))
    drawn = {text.get_text(): text.xy for text in axes.texts}
    assert drawn == {"J": (0, 0), "K": (200, 0), "L 1 s": (400, 0)}


def test_frames_are_scored_once(
    page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames: list[int] = []

    def scored(frame: int, *arguments: Any) -> FrameScore:
        frames.append(frame)
        return score_frame(frame, *arguments)

    monkeypatch.setattr(ecvpr, "score_frame", scored)
    assert run_page(tmp_path) == page
    assert frames == [*range(10)]


def test_a_run_with_one_junction_has_no_such_section(tmp_path: Path) -> None:
    (tmp_path / SETUP_NAME).write_bytes(encode(SETUP))
    database = Database(tmp_path)
    database.add(MetaRow, [("scenario", json.dumps({"name": "one", "frame_period_s": 0.1}))])
    database.close()
    assert SECTION not in [section.title for section in run_page(tmp_path).sections]
