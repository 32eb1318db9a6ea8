"""The page of a run: whole, cut off, empty, long, hostile."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import ConfigError
from protocol.messages import Setup, VehicleType
from protocol.wire import encode
from recording.database import FILE_NAME, Database
from recording.run import SETUP_NAME
from recording.tables import (
    CountRow,
    DetectionRow,
    FrameRow,
    LatencyRow,
    MetaRow,
    PhaseRow,
    RequestRow,
    TruthRow,
    UploadRow,
)  # fmt: skip
from studies.page.model import Chart, Code, MapChart, Page, Table, Text, Timeline, flattened
from studies.run_page import run_page
from tests.roads import WEST_TO_EAST
from tests.studies.page.pages import HOSTILE

MS = 1_000_000


def make_run(
    run_dir: Path, frames: int = 40, *, vehicle: str = "car-1", name: str = "demo"
) -> None:
    """A car passes a roadside LiDAR, seen in every second frame; another is never seen."""
    car = VehicleType(name="car", mesh="car", length_m=4.5, width_m=1.8, height_m=1.5)
    setup = Setup(
        scenario={"regions": {"r0": ["t"]}}, road_map=WEST_TO_EAST, vehicle_types=[car], meshes=[],
        mesh_vertices=np.zeros((0, 3)), mesh_triangles=np.zeros((0, 3)),
    )  # fmt: skip
    (run_dir / SETUP_NAME).write_bytes(encode(setup))
    database = Database(run_dir)
    scenario = {
        "name": name,
        "seed": 3,
        "frame_period_s": 0.1,
        "roadside_mounts": [{"id": "rsu", "x_m": 0, "y_m": 0}],
    }
    facts = {
        "scenario": json.dumps(scenario),
        "end_reason": "finished",
        "versions": '{"numpy":"2"}',
    }
    database.add(MetaRow, facts.items())
    took = dict.fromkeys(LatencyRow._fields[3:], MS)
    for n in range(frames):
        ns, at = n * 100 * MS, -90 + 80 * n / frames
        seen = n % 2
        database.add(FrameRow, [FrameRow(n, ns, 2, 0, 0, 1, 9, seen, 1, ns, ns, 40 * MS)])
        stamps = (ns, ns, ns, ns, None, ns, ns)
        database.add(UploadRow, [UploadRow(n, "r0", "rsu", 0, 9, 2000 + n, None, None, *stamps)])
        database.add(LatencyRow, [LatencyRow(n, "r0", "rsu", **took)])
        cars = [(vehicle, at), ("unseen", -50.0)]
        database.add(
            TruthRow,
            [TruthRow(n, v, "car", 0, x, 0, 0, 0, 0, 0, 9, "west", x + 100) for v, x in cars],
        )
        if seen:
            box = (at, 0, 0.7, 4.4, 1.8, 1.5, 0, 1.0, 0, "west", 20, "rsu")
            database.add(DetectionRow, [DetectionRow(n, "r0", 0, *box)])
        database.add(
            CountRow,
            [
                CountRow(n, "t", "west", "upstream", seen, 0),
                CountRow(n, "t", "east", "downstream", 0, 0),
            ],
        )
        stage = "green" if n % 20 < 15 else "yellow"
        database.add(PhaseRow, [PhaseRow(n, "t", ns, "G", stage, "G", "max_pressure")])
        database.add(RequestRow, [RequestRow(n, "t", "G", "max_pressure", "[1.0]", None, "", 0)])
    database.close()


def texts(page: Page) -> str:
    blocks = [block for section in page.sections for block in flattened(section.blocks)]
    return "\n".join(block.text for block in blocks if isinstance(block, Text))


def test_a_whole_run_has_all_figures(tmp_path: Path) -> None:
    make_run(tmp_path)
    page = run_page(tmp_path, "cpnet up demo")
    kinds = [type(figure) for figure in page.figures()]
    assert (kinds.count(Chart), kinds.count(Timeline), kinds.count(MapChart)) == (8, 1, 1)
    assert "came to its end after 4.0 simulated seconds" in page.lead
    blocks = [block for section in page.sections for block in flattened(section.blocks)]
    assert [b.text for b in blocks if isinstance(b, Code) and not b.folded] == ["cpnet up demo"]
    assert ("numpy", "2") in [row for b in blocks if isinstance(b, Table) for row in b.rows]


def test_the_map_shows_who_was_seen_and_who_was_missed(tmp_path: Path) -> None:
    make_run(tmp_path)
    places = next(f for f in run_page(tmp_path).figures() if isinstance(f, MapChart))
    points = {one.name: one for one in places.points}
    assert (len(points["detected"].x_m), len(points["missed"].x_m)) == (20, 60)
    assert list(points).index("missed") < list(points).index("detected"), "seen lie over missed"
    assert points["roadside LiDAR"].x_m == (0.0,)


def test_phases_last_until_the_next_one(tmp_path: Path) -> None:
    make_run(tmp_path)
    lamps = next(f for f in run_page(tmp_path).figures() if isinstance(f, Timeline))
    found = [(span.name, round(span.start, 6), round(span.end, 6)) for span in lamps.spans]
    assert found == [("green", 0, 1.5), ("yellow", 1.5, 2), ("green", 2, 3.5), ("yellow", 3.5, 4)]
    assert lamps.rows == ("A: west",)


def test_an_empty_run_says_what_is_missing(tmp_path: Path) -> None:
    Database(tmp_path).close()
    page = run_page(tmp_path)
    assert page.figures() == []
    for words in ("no truth", "No lane counts", "No signal state", "No agent sent", "No latency",
                  "There is no map", "The command is not known", "No scenario"):  # fmt: skip
        assert words in texts(page)
    assert "was cut off" in page.lead


@pytest.mark.parametrize(
    "table",
    ["frames", "uploads", "latency", "truth", "detections", "counts", "phases", "requests", "meta"],
)
def test_no_table_needs_to_hold_anything(tmp_path: Path, table: str) -> None:
    make_run(tmp_path)
    kept = " WHERE key <> 'schema_version'" if table == "meta" else ""
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as connection, connection:
        connection.execute(f"DELETE FROM {table}{kept}")
    assert len(run_page(tmp_path).sections) == 8


def test_a_run_without_its_setup_still_has_a_page(tmp_path: Path) -> None:
    make_run(tmp_path)
    (tmp_path / SETUP_NAME).unlink()
    page = run_page(tmp_path)
    assert "There is no map" in texts(page)
    assert [type(f) for f in page.figures()].count(Timeline) == 1


def test_a_run_with_hostile_names_has_a_safe_page(tmp_path: Path) -> None:
    pytest.importorskip("jinja2", reason="extra study")
    from studies.page.write import to_html

    make_run(tmp_path, vehicle=HOSTILE, name=HOSTILE)
    html = to_html(run_page(tmp_path, HOSTILE))
    assert HOSTILE not in html
    assert html == to_html(run_page(tmp_path, HOSTILE))


def test_a_long_run_has_a_page_that_is_not_much_larger(tmp_path: Path) -> None:
    make_run(tmp_path, frames=6_000)
    figures = run_page(tmp_path).figures()
    lines = [one for f in figures if isinstance(f, Chart) for one in f.series]
    assert max(len(one.x) for one in lines) <= 1_500
    places = next(f for f in figures if isinstance(f, MapChart))
    assert sum(len(one.x_m) for one in places.points) < 5_000


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is not a run"):
        run_page(tmp_path)
