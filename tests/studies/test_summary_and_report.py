"""The summary of runs: whole, empty, killed."""

import io
import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from rich.console import Console

from protocol.errors import ConfigError
from recording.database import Database
from recording.run import Run
from recording.tables import (
    TABLES,
    AlignmentRow,
    CountRow,
    DetectionRow,
    DropRow,
    FrameRow,
    LatencyRow,
    MetaRow,
    PhaseRow,
    RegionFrameRow,
    RequestRow,
    StageRow,
    TripRow,
    TruthRow,
    UploadRow,
)
from studies.comparison import differing_settings, print_comparison
from studies.latency import STAGE_GROUPS, STAGES
from studies.summary import print_report, summarise, to_json
from studies.uplink import scan_kilobytes
from tests.studies.straight_runs import write_setup

MS = 1_000_000


def whole_run(run_dir: Path) -> None:
    """Ten frames of 0.1 s, played in 0.6 s."""
    database = Database(run_dir)
    scenario = {"name": "demo", "seed": 3, "mode": "lockstep", "frame_period_s": 0.1}
    database.add(MetaRow, {"scenario": json.dumps(scenario), "end_reason": "finished"}.items())
    for frame in range(10):
        start = frame * 60 * MS
        row = FrameRow(
            frame, frame * 100 * MS, 5, 1, 0, 1, 9, 3, 1, start, start, (40 + frame) * MS
        )
        database.add(FrameRow, [row])
        sent = (start + 2 * MS, start + 8 * MS, start + 9 * MS, start + 10 * MS)
        wire = 2200 if frame else 0
        upload = UploadRow(
            frame, "r0", "rsu-0", 0, 9, 2000, wire, wire // 4, *sent, None, start + 12 * MS, None
        )
        database.add(UploadRow, [upload])
        database.add(StageRow, [StageRow(frame, "edge", "", "detect", start, (frame + 1) * MS)])
        took = dict.fromkeys(LatencyRow._fields[3:], 0) | {
            "link_ns": 3 * MS,
            "clock_error_ns": frame,
        }
        database.add(LatencyRow, [LatencyRow(frame, "r0", "rsu-0", **took)])
        state, stage = ("Gr", "green") if frame < 4 else ("rG", "green")
        stage = "yellow" if frame == 4 else stage
        database.add(PhaseRow, [PhaseRow(frame, "t", frame * 100 * MS, state, stage, state, "p")])
        unknown = "a b" if frame < 3 else ""
        asked = RequestRow(frame, "t", state, "max_pressure", "[]", None, unknown, 0)
        database.add(RequestRow, [asked])
    database.add(
        TripRow,
        [
            TripRow("a", 0, 0.0, 9.0, 4.0, 0, 1, 200.0),
            TripRow("b", 1, 0.0, 8.0, 2.0, 1, 0, 100.0),
            TripRow("c", 1, 0.0, None, 90.0, 0, 5, 600.0),
        ],
    )
    database.add(DropRow, [DropRow("edge", "late", 2), DropRow("sim", "late", 3)])
    database.close()


def test_the_summary_holds_the_figures_of_a_run(tmp_path: Path) -> None:
    whole_run(tmp_path)
    summary = summarise(tmp_path)
    assert (summary["scenario"], summary["ended"]) == ("demo", "finished")
    assert (summary["frames"], summary["sim_duration_s"]) == (10, 1.0)
    assert summary["real_time_factor"] == pytest.approx(100 / 60)
    agent = summary["agents"]["rsu-0"]
    assert (agent["frames"], agent["bytes_per_frame"]) == (10, 2000)
    assert agent["mbps"] == pytest.approx(0.16)
    assert agent["wire_bytes_per_frame"] == pytest.approx(1980)
    assert agent["wire_mbps"] == pytest.approx(0.1584)
    assert agent["wire_down_mbps"] == pytest.approx(0.0396)
    assert summary["wire_mbps"] == {"up": pytest.approx(0.1584), "down": pytest.approx(0.0396)}
    with Run(tmp_path) as run:
        assert scan_kilobytes(run) == {"mean": 2.0, "peak": 2.0}
    assert list(summary["latency_ms"]) == list(STAGES)
    assert summary["latency_ms"]["end_to_end"]["p50"] == pytest.approx(44.5)
    assert summary["latency_ms"]["sense"]["p99"] is None
    assert summary["clock_error_ms"] == pytest.approx(9e-6)
    assert summary["latency_ms"]["link"]["p50"] == pytest.approx(3.0)
    assert summary["latency_ms"]["detect"]["p50"] == pytest.approx(5.5)
    assert summary["latency_ms"]["decode"]["p50"] is None
    assert summary["delay_s"]["mean"] == pytest.approx(32)  # of all, arrived or not
    assert summary["delay_s"]["p95"] == pytest.approx(4 + 0.9 * 86)
    assert (summary["stops"], summary["co2_g"]) == (2.0, 300.0)
    assert summary["vehicles"] == {
        "at_start": 0,
        "inserted": 3,
        "finished": 2,
        "teleported": 1,
        "waiting": None,
    }
    assert summary["phases"] == {"switches": 1}
    assert summary["unknown_share"] == pytest.approx(0.3)
    assert summary["drops"] == 5
    assert summary["drops_by_reason"] == {"edge": {"late": 2}, "sim": {"late": 3}}


def test_an_empty_run_has_the_same_keys_and_no_figures(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    (tmp_path / "empty").mkdir()
    whole_run(tmp_path / "whole")
    Database(tmp_path / "empty").close()
    empty, whole = summarise(tmp_path / "empty"), summarise(tmp_path / "whole")
    assert list(empty) == list(whole)
    assert list(empty["latency_ms"]) == list(STAGES)
    assert (empty["frames"], empty["sim_duration_s"], empty["real_time_factor"]) == (0, 0.0, None)
    assert empty["e_cvpr"] == {"mean": None, "std": None}
    assert empty["delay_s"]["mean"] is None
    assert json.loads(to_json(empty)) == empty


@pytest.mark.parametrize("is_empty", [True, False])
def test_the_report_fits_on_a_screen(tmp_path: Path, is_empty: bool) -> None:
    if is_empty:
        Database(tmp_path).close()
    else:
        whole_run(tmp_path)
    text = io.StringIO()
    print_report(summarise(tmp_path), Console(file=text, width=100))
    lines = text.getvalue().splitlines()
    assert len(lines) < 45
    assert any("end to end" in line for line in lines)
    assert any("E-CVPR" in line for line in lines)
    assert is_empty == ("cut off" in lines[0])


def test_two_runs_stand_side_by_side_with_the_difference(tmp_path: Path) -> None:
    for name in ("one", "other", "empty"):
        (tmp_path / name).mkdir()
    whole_run(tmp_path / "one")
    whole_run(tmp_path / "other")
    Database(tmp_path / "empty").close()

    def compared(a: str, b: str) -> dict[str, list[str]]:
        text = io.StringIO()
        print_comparison(tmp_path / a, tmp_path / b, Console(file=text, width=100))
        rows = [line.split("  ") for line in text.getvalue().splitlines()]
        return {row[0].strip(): [cell.strip() for cell in row[1:] if cell.strip()] for row in rows}

    same = compared("one", "other")
    assert same["frames"] == ["10", "10", "0"]
    assert same["end-to-end latency, p50 in ms"] == ["44.5", "44.5", "0"]
    assert compared("one", "empty")["frames"] == ["10", "0", "+10"]
    assert "-100.0 %" in compared("empty", "one")["frames"]


def test_settings_that_differ_stand_above_the_measures(tmp_path: Path) -> None:
    for name, profile in (("a", "1mbit"), ("b", "[2mbit]")):
        (tmp_path / name).mkdir()
        scenario = {"link": {"profile": profile}, "seed": 1, "name": name}
        database = Database(tmp_path / name)
        database.add(MetaRow, {"scenario": json.dumps(scenario)}.items())
        database.close()
    assert differing_settings(tmp_path / "a", tmp_path / "b") == [
        ("link.profile", '"1mbit"', '"[2mbit]"'),
        ("name", '"a"', '"b"'),
    ]
    text = io.StringIO()
    print_comparison(tmp_path / "a", tmp_path / "b", Console(file=text, width=100))
    assert text.getvalue().index("[2mbit]") < text.getvalue().index("frames")


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is not a run"):
        summarise(tmp_path)


def test_each_region_and_each_junction_has_its_figures(tmp_path: Path) -> None:
    write_setup(tmp_path)
    database = Database(tmp_path)
    scenario = json.dumps({"frame_period_s": 1.0, "seed": 1, "name": "city"})
    database.add(MetaRow, {"scenario": scenario}.items())
    chunk = (0, 9, 125_000, *(None,) * 9)
    for frame, regions in enumerate((["r0"], ["r0", "r1"], ["r1"])):
        database.add(FrameRow, [FrameRow(frame, frame * 10**9, 1, 1, 0, 1, 9, 1, 1, frame, 5, 5)])
        for region in regions:
            database.add(UploadRow, [UploadRow(frame, region, "a", *chunk)])
            row = RegionFrameRow(frame, region, 1, 9, 1, 1, 0, 5, (frame + 1) * MS)
            database.add(RegionFrameRow, [row])
    states = [("G", 0), ("r", 1), ("G", 2)]
    database.add(
        PhaseRow, [PhaseRow(n, "j", n, green, "green", green, "plan") for green, n in states]
    )
    at = (-60.0, 0, 0, 0, 0, 0, 5.0, "in", 95.0)
    database.add(TruthRow, [TruthRow(n, "a", "car", 1, *at) for n in range(3)])
    database.add(CountRow, [CountRow(n, "j", "in", "upstream", 2, 0) for n in range(3)])
    database.add(
        DetectionRow,
        [DetectionRow(1, "r0", 0, -60, 0, 0.75, 4.5, 1.8, 1.5, 0, 1, 0, "in", 55, "a")],
    )
    database.commit()
    database.close()
    summary = summarise(tmp_path)
    assert summary["regions"] == {
        "r0": {"agents": 1, "mbps": pytest.approx(2 / 3), "latency_ms": 1.5, "handovers": 0},
        "r1": {"agents": 1, "mbps": pytest.approx(2 / 3), "latency_ms": 2.5, "handovers": 1},
    }
    assert summary["junctions"] == {
        "j": {
            "e_cvpr": pytest.approx(1 / 3),  # it reports itself once
            "delay_s": pytest.approx(1.5),  # at half the limit, three seconds
            "switches": 2,
            "count_error": 1,
            "mbps": pytest.approx(4 / 3),  # of both regions
        }
    }


def test_a_report_tells_by_how_much_agents_were_off_when_last_aligned(tmp_path: Path) -> None:
    whole_run(tmp_path)
    off = [
        AlignmentRow(1, "r0", "rsu-0", 9.0, 0, 0, 0, 0.1, 500, 0.9, 0),
        AlignmentRow(6, "r0", "rsu-0", 0.3, -0.4, 0, 0.01, 0.05, 500, 0.9, 0),
        AlignmentRow(6, "r0", "liar", 0, 0, 0, 0, 1.0, 500, 0.1, 1),
        AlignmentRow(6, "r0", "far", 0, 0, 0, 0, 1.0, 0, 0.0, 0),
    ]
    with closing(sqlite3.connect(tmp_path / "run.sqlite")) as database:
        database.executemany(TABLES[AlignmentRow].insert, off)
        database.commit()
    summary = summarise(tmp_path)
    assert summary["alignments"] == {
        "rsu-0": {"x_m": 0.3, "y_m": -0.4, "yaw_deg": 0.573, "std_m": 0.05, "contradicting": 0},
        "liar": {"contradicting": 1},
    }
    out = io.StringIO()
    print_report(summary, Console(file=out, width=120))
    assert "off m" in out.getvalue()
    assert "0.50" in out.getvalue()


def test_every_measured_stage_of_an_agents_way_stands_in_a_group_and_in_the_summary() -> None:
    columns = {name.removesuffix("_ns") for name in LatencyRow._fields if name.endswith("_ns")}
    stages = columns - {"end_to_end", "clock_error"}
    assert {stage for group in STAGE_GROUPS.values() for stage in group} == stages
    assert stages <= set(STAGES)
