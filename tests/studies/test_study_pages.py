"""Pages about studies: tables and charts of all cells, and what they say of expectations."""

from __future__ import annotations

from typing import Any

import pytest

pl = pytest.importorskip("polars", reason="needs the extra `study`")

from studies.page.model import Chart, Page, Table  # noqa: E402
from studies.page.write import to_html, to_markdown  # noqa: E402
from studies.paper_page import claims, paper_page, points_or_interval  # noqa: E402
from studies.study_page import RATE, bandwidth_page, plain_page  # noqa: E402
from studies.study_tables import StudyResults  # noqa: E402
from studies.sweep.study_file import Study, read_study  # noqa: E402
from studies.sweep.worker import HISTOGRAM_BINS  # noqa: E402
from studies.value_page import value_page  # noqa: E402

ROW = {
    "frames": 10, "e_cvpr": 0.6, "e_cvpr_std": 0.1, "e_cvpr_hist": [1] * HISTOGRAM_BINS,
    "visible_share": 0.65, "in_range_share": 0.7, "count_error": 0.5, "delay_s": 12.0,
    "uplink_mbps": 2.0, "false_detections": 0.2, "vehicles_inserted": 100,
    "vehicles_finished": 90, "vehicles_teleported": 0, "vehicles_waiting": 0,
}  # fmt: skip


def findings(study: Study, **changes: Any) -> StudyResults:
    """Returns a study whose cells all have one row's figures; `changes` maps labels to figures."""
    rows = []
    for grid in study.grids:
        points: list[dict[str, Any]] = [{}]
        for name, axis in grid.axes.items():
            points = [point | {name: label} for point in points for label in axis]
        for point in points:
            for seed in study.seeds:
                row = {"grid": grid.name, **point, "seed": seed, **ROW}
                row["delay_s"] += 0.1 * seed
                rows.append(row | changes.get("change", lambda _: {})(row))
    names = list(dict.fromkeys(name for row in rows for name in row))
    whole = [{name: row.get(name) for name in names} for row in rows]
    frame = pl.DataFrame(whole, strict=False, infer_schema_length=None)
    return StudyResults(study, frame, "cpnet study mine", {"python": "3.11"})


def tables(page: Page) -> list[Table]:
    return [block for part in page.sections for block in part.blocks if isinstance(block, Table)]


def plain_study() -> Study:
    return Study.model_validate(
        {
            "name": "mine",
            "seeds": [1, 2],
            "grids": [
                {
                    "name": "rates",
                    "axes": {"traffic.cav_rate": [0, 0.1], "edge.detector": ["fast"]},
                },
                {"name": "words", "axes": {"controller": {"a": {}, "b": {"mode": "lockstep"}}}},
            ],
        }
    )


def test_every_grid_has_its_table_with_whom_a_delay_is_the_mean_of():
    page = plain_page(findings(plain_study()))
    rates, _, words, _, versions = tables(page)
    names = [column.name for column in rates.columns]
    assert names[:3] == ["traffic.cav_rate", "edge.detector", "mean delay, s"]
    assert {"inserted", "finished", "teleported", "not inserted", "seeds"} <= set(names)
    assert rates.rows[0][:3] == (
        "0",
        "fast",
        "12.1 (12.1, 12.2)",
    )  # 12.15, as floats have it
    assert [row[0] for row in words.rows] == ["a", "b"]
    assert versions.rows == (("python", "3.11"),)


def test_an_axis_of_numbers_is_a_curve_and_one_of_words_are_bars():
    charts = plain_page(findings(plain_study())).figures()
    assert all(isinstance(chart, Chart) for chart in charts)
    assert [chart.kind for chart in charts] == ["line"] * 3 + ["bar"] * 3
    assert charts[0].series[0].x == (0, 0.1)


def test_a_measure_without_values_is_neither_column_nor_chart():
    page = plain_page(findings(plain_study(), change=lambda _: {"e_cvpr": None}))
    assert "E-CVPR, %" not in [column.name for column in tables(page)[0].columns]
    assert len(page.figures()) == 4


def test_the_papers_figures_stand_beside_ours():
    page = paper_page(findings(read_study("paper").study))
    table = next(t for t in tables(page) if t.caption.startswith("Table 2"))
    theirs = {(row[0], row[1]): row[-1] for row in table.rows}
    assert theirs["pointpillars", "5"] == 46.6
    assert theirs["fast", "1"] == 35.4
    assert theirs["fast", "5"] is None  # they do not give it
    assert table.rows[0][2] == "60.0 (60.0, 60.0, 60.0)"


def test_delays_of_other_controllers_are_paired_by_seed_with_those_on_perception():
    def by_seed(row: dict[str, Any]) -> dict[str, Any]:
        return {"delay_s": row["seed"] + (2.0 if row.get("controller") == "fixed plan" else 0.5)}

    page = paper_page(findings(read_study("paper").study, change=by_seed))
    table = next(t for t in tables(page) if t.caption.startswith("More delay than"))
    at = [column.name for column in table.columns].index("fixed plan, s")
    assert {row[at] for row in table.rows} == {"+1.5, +1.5, +1.5"}


def test_of_five_seeds_the_interval_is_shown_of_fewer_the_points():
    assert points_or_interval([1.0, -2.0]) == "+1.0, -2.0"
    assert points_or_interval([1.0, 2.0, 3.0, 4.0, 5.0]) == "+3.0 ± 2.0"
    assert points_or_interval([]) is None


def good(row: dict[str, Any]) -> dict[str, Any]:
    """Figures as they are expected."""
    share = row.get("traffic.cav_rate")
    reports = row.get("traffic.cv_rate")
    if share is not None:
        return {"e_cvpr": 0.6 + share, "visible_share": 0.65 + share}
    if reports is not None:
        return {"delay_s": 12.0 + max(0, 0.3 - reports) * 20}
    return {"delay_s": 11.5} if row["controller"] == "max pressure, perfect counts" else {}


def test_what_is_as_expected_holds():
    found = claims(findings(read_study("paper").study, change=good))
    assert len(found) == 6
    assert all(claim.holds for claim in found), [c for c in found if not c.holds]


@pytest.mark.parametrize(
    ("broken", "text"),
    [
        (lambda row: {"e_cvpr": 0.6 - (row.get("traffic.cav_rate") or 0)}, "rises"),
        (lambda row: {"visible_share": 0.9}, "of the visible share"),
        (lambda row: {"delay_s": 9.0} if row.get("traffic.cv_rate") == 0.02 else {}, "falls"),
        (lambda row: {"delay_s": 15.0} if row.get("traffic.cv_rate") == 0.6 else {}, "flat"),
    ],
)
def test_what_is_not_as_expected_is_said(broken, text):
    study = read_study("paper").study
    found = claims(findings(study, change=lambda row: good(row) | broken(row)))
    assert not all(claim.holds for claim in found if text in claim.text)


def test_enough_is_the_slowest_uplink_that_sees_nearly_all():
    def change(row: dict[str, Any]) -> dict[str, Any]:
        rate = row.get(RATE)
        return {} if rate is None else {"e_cvpr": 0.1 if rate < 0.3 else 0.699 if rate < 1 else 0.7}

    page = bandwidth_page(findings(read_study("bandwidth").study, change=change))
    answers = tables(page)[0]
    assert len(answers.rows) == 3 + 4 * 2
    found = {(row[0], row[2]) for row in answers.rows}
    assert ("Ten times a second: without ground and background", "0.42") in found
    assert ("Ten times a second: boxes", "100") in found
    slow = next(row for row in answers.rows if row[2] == "0.42")
    assert slow[3:6] == ("69.9 ± 0.0", "-0.1 ± 0.0", None)  # no delay of runs of 20 s
    assert answers.rows[0][2:6] == ("1", "70.0 ± 0.0", "+0.0 ± 0.0", "12.3 ± 0.2")


def test_from_five_seeds_on_an_interval_is_shown_that_ends_where_possible_values_do():
    study = plain_study().model_copy(update={"seeds": [1, 2, 3, 4, 5]})

    def change(row: dict[str, Any]) -> dict[str, Any]:
        return {"e_cvpr": (0.2, 1.0, 1.0, 1.0, 1.0)[row["seed"] - 1]}

    page = plain_page(findings(study, change=change))
    table = tables(page)[0]
    at = [column.name for column in table.columns].index("E-CVPR, %")
    assert table.rows[0][at] == "84.0 (39.6 to 100.0)"
    charts = [chart for chart in page.figures() if isinstance(chart, Chart)]
    seen = next(chart for chart in charts if chart.title.startswith("E-CVPR")).series[0]
    assert seen.high is not None
    assert seen.high[0] == 100.0
    assert seen.points == ()


def test_below_five_seeds_points_are_drawn_and_no_interval():
    charts = [c for c in plain_page(findings(plain_study())).figures() if isinstance(c, Chart)]
    delay = charts[0].series[0]
    assert delay.low is None
    assert delay.points[0] == pytest.approx((12.1, 12.2))


def test_differences_are_paired_by_seed():
    def change(row: dict[str, Any]) -> dict[str, Any]:
        more = 1.0 + 0.1 * (row["seed"] % 2) if row.get("traffic.cav_rate") else 0.0
        return {"delay_s": 10.0 * row["seed"] + more}

    page = plain_page(findings(plain_study(), change=change))
    paired = tables(page)[1]
    assert "paired by seed" in paired.caption
    assert paired.rows[0][:3] == ("0.1", "fast", "+1.0 (+1.1, +1.0)")


def test_pages_can_be_drawn_both_ways(tmp_path):
    pytest.importorskip("jinja2", reason="needs the extra `study`")
    plain = plain_page(findings(plain_study()))
    for page in (
        plain,
        paper_page(findings(read_study("paper").study)),
        bandwidth_page(findings(read_study("bandwidth").study)),
    ):
        assert page.title in to_html(page)
    text = to_markdown(plain, tmp_path / "figures", "figures")
    assert text.count("![") == len(list((tmp_path / "figures").glob("*.png"))) == 6


def test_a_study_without_a_finished_cell_has_a_page():
    study = plain_study()
    empty = findings(study).frame.clear()
    assert to_html(plain_page(StudyResults(study, empty, "cpnet study mine")))


def test_delay_suffers_from_the_first_point_that_is_worse_than_the_best_in_pairs() -> None:
    controllers = {name: {"signal.policy": "predictive"} for name in ("predictive", "max pressure")}
    axes = {"link.profile": ["1mbit", "2mbit", "3mbit"], "controller": controllers}
    latencies = {ms: {"link.profile": f"1mbit,{ms}ms"} for ms in ("20", "900")}
    delays = {"latency in ms": latencies, "controller": controllers}
    grids = [{"name": "rate", "axes": axes}, {"name": "late", "axes": delays}]
    study = Study.model_validate({"name": "value", "seeds": [1, 2, 3], "grids": grids})

    def change(row: dict[str, Any]) -> dict[str, Any]:
        is_slow = row["controller"] == "predictive" and row.get("link.profile") == "1mbit"
        little = 0.2 * (row.get("link.profile") == "2mbit")
        late = 3.0 * (row.get("latency in ms") == "900")
        return {"delay_s": 10 + row["seed"] + 2.5 * is_slow + little + late}

    page = value_page(findings(study, change=change))
    rate, late = (block for block in page.sections[0].blocks if isinstance(block, Table))
    assert rate.rows == (
        ("predictive", "3mbit", 12.0, "1mbit", "2.50 ± 0.00"),
        ("max pressure", "3mbit", 12.0, None, None),
    )
    assert {row[1:] for row in late.rows} == {("20", 12.0, "900", "3.00 ± 0.00")}
