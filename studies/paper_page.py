"""The page of the study `paper`: the tables and figures of Chen et al. 2022 beside cpnet's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import polars as pl
from scipy.stats import t as student_t

from studies.ecvpr import VISIBLE_POINTS
from studies.page.model import Block, Cell, Chart, Column, Fact, Page, Section, Series, Table, Text
from studies.study_tables import (
    DELAY,
    E_CVPR,
    GridRow,
    StudyResults,
    bars,
    curve,
    figure_of,
    grid_table,
    label_of,
    mean_of,
    origin_section,
)

E_CVPR_MEAN: dict[str, dict[float, float]] = {
    "DBSCAN": {0: 29.9, 0.01: 35.4, 0.02: 38.3},
    "PointPillars": {0: 31.4, 0.01: 35.7, 0.02: 37.4, 0.05: 46.6},
}
"""Table 2, per cent by share of CAVs; standard deviations are 10 to 15."""

DELAY_S = (10.6, 11.0)
"""Table 3: the mean delays of all cells lie between these."""

PUBLISHED_DETECTOR = {"fast": "DBSCAN", "reference": "DBSCAN", "pointpillars": "PointPillars"}
"""Their detector for ours."""


OF_VISIBLE = 0.9
LEVEL_WITHIN = 0.10
FLAT_FROM = 0.3
LEAST_SEEDS = 5  # for an interval; of fewer, the points are shown
_DETECTOR, _CAV, _CV = "edge.detector", "traffic.cav_rate", "traffic.cv_rate"


@dataclass(frozen=True, slots=True)
class Claim:
    """An expectation, the measured value, and whether it is met."""

    text: str
    measured: str
    holds: bool


def claims_section(findings: StudyResults) -> Section:
    """Returns the expectations as a table, which heads the page."""
    rows = tuple(
        (claim.text, claim.measured, "yes" if claim.holds else "no") for claim in claims(findings)
    )
    columns = (Column("expected"), Column("measured"), Column("holds"))
    blocks: tuple[Block, ...] = (Table(columns, rows), *map(Text, _notes(findings)))
    return Section("Expected and measured", blocks)


def claims(findings: StudyResults) -> list[Claim]:
    """Returns the claims that the study's rows can answer."""
    perception = findings.rows("perception")
    detectors = list(dict.fromkeys(str(row[_DETECTOR]) for row in perception))
    found = []
    for detector in detectors:
        rows = sorted(
            (row for row in perception if row[_DETECTOR] == detector),
            key=lambda row: figure_of(row, _CAV) or 0.0,
        )
        found += list(_of_detector(detector, rows))
    return found + list(_of_reports(findings.rows("reports")))


def _notes(findings: StudyResults) -> Iterator[str]:
    """Yields explanations of unexpected figures."""
    perception = findings.rows("perception")
    shares = [
        (figure_of(row, "e_cvpr_mean"), figure_of(row, "visible_share_mean")) for row in perception
    ]
    if any(found and visible and found > visible for found, visible in shares):
        yield (
            f"E-CVPR above the visible share: a vehicle that fewer than {VISIBLE_POINTS} points "
            "lie on does not count as visible, but may still be found. That rule is ours."
        )
    counts, queues = (_delay_with(findings, name) for name in ("perfect counts", "perfect queues"))
    delays = [delay for row in perception if (delay := figure_of(row, "delay_s_mean")) is not None]
    empty = findings.rows("unseen-empty")
    if empty and delays:
        yield (
            f"The match with the delays of Chen et al., {DELAY_S[0]} to {DELAY_S[1]} s, rests on "
            "signal.unseen: alike, which is ours. With empty, as theirs: "
            + ", ".join(f"{mean_of(row, DELAY)} s" for row in empty)
            + f" ({label_of(empty[0][_DETECTOR])}, "
            f"{100 * (figure_of(empty[0], _CAV) or 0):g} % CAVs)."
        )
    if counts and delays and min(delays) < counts:
        yield (
            "Less delay than with perfect counts: these are neither a lower bound nor a goal for "
            "max pressure, which does better on fewer metres before the stop bar: see the tuned "
            "rows under other controllers. The "
            "likely cause, not tested by itself: they weigh a vehicle that is far away, and that "
            "the next seconds of green do not serve, as much as one at the stop bar, whereas a "
            "roadside LiDAR sees the nearer part of an approach."
        )
    if counts and queues and queues > counts:
        yield (
            "More delay by queues than by counts, likely because a platoon that approaches weighs "
            "nothing until it has been stopped."
        )
    yield (
        "Intervals of delays are wide because demand is drawn anew for each seed. It is the same "
        "in all cells of a seed, so that differences between cells are surer than they say."
    )


def _delay_with(findings: StudyResults, controller: str) -> float | None:
    rows = [row for row in findings.rows("control") if controller in str(row["controller"])]
    return figure_of(rows[0], "delay_s_mean") if rows else None


def _of_detector(name: str, rows: list[GridRow]) -> Iterator[Claim]:
    rows = [row for row in rows if figure_of(row, "e_cvpr_mean") is not None]
    shares = [figure_of(row, "e_cvpr_mean") or 0.0 for row in rows]
    rising = all(a <= b for a, b in pairwise(shares)) and shares[:1] < shares[-1:]
    listed = ", ".join(f"{100 * share:.1f}" for share in shares)
    yield Claim(f"{name}: E-CVPR rises with the share of CAVs", f"{listed} %", rising)
    of_visible = [
        share / visible
        for row, share in zip(rows, shares, strict=True)
        if (visible := figure_of(row, "visible_share_mean"))
    ]
    if of_visible:
        least = min(of_visible)
        text = f"{name}: E-CVPR is at least {100 * OF_VISIBLE:g} % of the visible share"
        yield Claim(text, f"{100 * least:.1f} % at least", least >= OF_VISIBLE)


def _of_reports(rows: list[GridRow]) -> Iterator[Claim]:
    """The curve falls, and is flat from a share on: within its own confidence interval."""
    curve = sorted(
        (share, delay, figure_of(row, "delay_s_ci95") or 0.0)
        for row in rows
        if (share := figure_of(row, _CV)) is not None
        and (delay := figure_of(row, "delay_s_mean")) is not None
    )
    flat = [one for one in curve if one[0] >= FLAT_FROM - 1e-9]
    steep = [one for one in curve if one[0] < FLAT_FROM - 1e-9]
    if not flat or not steep:
        return
    level = sum(delay for _, delay, _ in flat) / len(flat)
    first = steep[0]
    text = "delay with reports alone falls with their share"
    measured = f"{first[1]:.1f} s at {100 * first[0]:g} %, {level:.1f} s from {100 * FLAT_FROM:g} %"
    yield Claim(text, measured, all(one[1] > level for one in steep))
    spread = max(delay for _, delay, _ in flat) - min(delay for _, delay, _ in flat)
    text = f"and is flat from about {100 * FLAT_FROM:g} %"
    measured = f"{spread:.1f} s between the highest and the lowest, of {level:.1f} s"
    yield Claim(text, measured, spread <= LEVEL_WITHIN * level)


CAV, CV, DETECTOR = "traffic.cav_rate", "traffic.cv_rate", "edge.detector"


def paper_page(findings: StudyResults, sections: Sequence[Section] = ()) -> Page:
    """Returns the page; further sections, such as those of accuracy, come before the tables."""
    study = findings.study
    duration_s, period_s = (
        float(findings.scenario.get(key, 0)) for key in ("duration_s", "frame_period_s")
    )
    lead = (
        "Chen et al. 2022, A Cooperative Perception Environment for Traffic Operations and "
        f"Control: its tables and figures, from {len(findings.frame)} runs of "
        f"{duration_s:g} s with perception every {period_s:g} s, {len(study.seeds)} seeds a cell. "
        "Theirs come from CARLA's Town04, ours from "
        "another simulator and, where nothing else is stated, a generated junction of the same "
        "shape and demand: they tell the order of magnitude, not a ranking." + findings.gaps()
    )
    return Page(
        study.title or study.name,
        lead,
        (
            claims_section(findings),
            *sections,
            _e_cvpr_section(findings),
            _delay_section(findings),
            _reports_section(findings),
            _control_section(findings),
            *findings.networks,
            origin_section(findings),
        ),
        _facts(findings),
    )


def _facts(findings: StudyResults) -> tuple[Fact, ...]:
    best = max(findings.rows("perception"), key=lambda r: figure_of(r, CAV) or 0.0, default=None)
    if best is None:
        return ()
    at = f"at {100 * (figure_of(best, CAV) or 0):g} % CAVs, {best[DETECTOR]}"
    pairs = (("E-CVPR, %", E_CVPR), ("mean delay, s", DELAY))
    return tuple(Fact(name, mean_of(best, shown) or "–", at) for name, shown in pairs)


def _e_cvpr_section(findings: StudyResults) -> Section:
    rows = findings.rows("perception")
    cells = tuple(_e_cvpr_row(row) for row in rows)
    names = ("s.d. over frames", "visible, %", "in range, %", "of the visible, %", "Chen et al., %")
    columns = (
        *map(Column, ("detector", "CAVs, %", "E-CVPR, %")),
        *(Column(name, ".1f") for name in names),
    )
    caption = (
        "Table 2. Vehicles truly detected, of those within 200 m before the stop bar and 100 m "
        "behind it: mean ± half the 95 % confidence interval over seeds. Visible: "
        f"{VISIBLE_POINTS} points or more in all scans together, or reporting itself; the rule is "
        "ours. Theirs have standard deviations of 10 to 15; their sensors' points a second and "
        f"range are not stated. {lidars_of(findings.scenario)}"
    )
    blocks: list[Block] = [Table(columns, cells, caption)]
    detectors = list(dict.fromkeys(str(row[DETECTOR]) for row in rows))
    blocks += [_histogram(findings, detector) for detector in detectors]
    return Section("E-CVPR by share of CAVs (Table 2, Figure 8)", tuple(blocks))


def lidars_of(scenario: Mapping[str, Any]) -> str:
    """Returns a sentence on the LiDARs of a scenario; empty if it does not say."""
    kinds = {"CAVs": "vehicle", "posts": "roadside"}
    lidar = scenario.get("lidar", {})
    words = [
        f"{name} {lidar[kind]['channels']} rings, {lidar[kind]['points_per_second']:,} points a "
        f"second, range {lidar[kind]['range']:g} m"
        for name, kind in kinds.items()
        if kind in lidar
    ]
    return f"Ours: {'; '.join(words)}." if words else ""


def _e_cvpr_row(row: GridRow) -> tuple[Cell, ...]:
    share, detector = figure_of(row, CAV) or 0.0, str(row[DETECTOR])
    theirs = E_CVPR_MEAN.get(PUBLISHED_DETECTOR.get(detector, ""), {}).get(share)
    found, visible = figure_of(row, "e_cvpr_mean"), figure_of(row, "visible_share_mean")
    return (
        detector,
        label_of(100 * share),
        mean_of(row, E_CVPR),
        _percent(figure_of(row, "e_cvpr_std_mean")),
        _percent(visible),
        _percent(figure_of(row, "in_range_share_mean")),
        None if found is None or not visible else round(100 * found / visible, 1),
        theirs,
    )


def _histogram(findings: StudyResults, detector: str) -> Chart:
    part = findings.frame.filter((pl.col("grid") == "perception") & (pl.col(DETECTOR) == detector))
    series = []
    for share in part[CAV].unique(maintain_order=True):
        counts = np.array(part.filter(pl.col(CAV) == share)["e_cvpr_hist"].to_list()).sum(axis=0)
        edges = np.linspace(0, 100, len(counts) + 1)
        frames = 100 * counts / max(1, counts.sum())
        name = f"{100 * share:g} % CAVs"
        x, y = (edges[:-1] + edges[1:]) / 2, frames
        series.append(Series(name, tuple(x.tolist()), tuple(y.tolist()), style="line"))
    return Chart(
        f"Figure 8, {detector}: how often each E-CVPR occurs", "E-CVPR, %", "frames, %",
        tuple(series), "line",
    )  # fmt: skip


def _delay_section(findings: StudyResults) -> Section:
    rows = findings.rows("perception")
    low, high = DELAY_S
    caption = (
        f"Table 3. Time lost on a journey, of all vehicles. Chen et al.: {low} to {high} s in all "
        "cells. Vehicles are means over seeds; not inserted: those that found no room to enter."
    )
    blocks: list[Block] = [grid_table(rows, [DETECTOR, CAV], caption)]
    blocks.append(bars(rows, [DETECTOR, CAV], DELAY))
    empty = findings.rows("unseen-empty")
    if empty:
        note = (
            "The same with signal.unseen: empty, as in the paper. A roadside LiDAR sees 100 m of "
            "the 200 m that count before the stop bar, but all that counts behind it. Above, the "
            "controller takes a lane's unseen part for as full as the rest; here, for empty."
        )
        blocks.append(grid_table(empty, [DETECTOR, CAV], note))
    paired = _paired_table(findings)
    if paired.rows:
        blocks.append(paired)
    return Section("Delay with cooperative perception (Table 3)", tuple(blocks))


def _paired_table(findings: StudyResults) -> Table:
    """Returns how much more delay each other control has than perception, paired by seed."""
    others = findings.frame.filter(pl.col("grid") == "control")
    grid = findings.frame.filter(pl.col("grid") == "perception")
    columns = [Column("on perception")]
    names = others["controller"].unique(maintain_order=True) if len(others) else []
    columns += [Column(f"{name}, s") for name in names]
    rows = []
    for (detector, share), part in grid.group_by([DETECTOR, CAV], maintain_order=True):
        own = dict(part.select("seed", "delay_s").iter_rows())
        cells: list[Cell] = [f"{detector}, {100 * float(share):g} % CAVs"]
        for name in names:
            other = others.filter(pl.col("controller") == name).select("seed", "delay_s")
            cells.append(
                points_or_interval(
                    [
                        delay_s - own[seed]
                        for seed, delay_s in other.iter_rows()
                        if delay_s is not None and own.get(seed) is not None
                    ]
                )
            )
        rows.append(tuple(cells))
    caption = (
        "More delay than max pressure on perception, by controller, paired by seed: negative where "
        f"the other is better. Below {LEAST_SEEDS} seeds, each seed's difference."
    )
    return Table(tuple(columns), tuple(rows), caption)


def points_or_interval(values: Sequence[float]) -> str | None:
    """Returns mean ± half its 95 % interval; below five values these themselves."""
    if len(values) < LEAST_SEEDS:
        return ", ".join(f"{value:+.1f}" for value in values) or None
    mean = float(np.mean(values))
    half = float(student_t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1))
    return f"{mean:+.1f} ± {half / len(values) ** 0.5:.1f}"


def _reports_section(findings: StudyResults) -> Section:
    rows = findings.rows("reports")
    ours = curve(rows, CV, DELAY, "max pressure on reports")
    lines = [_level(row, ours) for row in findings.rows("control")]
    chart = Chart(
        "Figure 9: delay by share of vehicles that report themselves",
        "share of vehicles that report themselves", "mean delay, s",
        (ours, *(line for line in lines if line is not None)), x_log=True,
    )  # fmt: skip
    text = (
        "No LiDAR here: vehicles report where they are, with the error of satellite positioning, "
        "and the others are unknown. The level lines are other controllers on the same demand."
    )
    blocks = (Text(text), chart, grid_table(rows, [CV]))
    return Section("Delay with connected vehicles alone (Figure 9)", blocks)


def _level(row: GridRow, over: Series) -> Series | None:
    mean = figure_of(row, "delay_s_mean")
    if mean is None or not over.x:
        return None
    ends = (over.x[0], over.x[-1])
    return Series(str(row["controller"]), ends, (mean, mean), style="dashed")


def _control_section(findings: StudyResults) -> Section:
    rows = findings.rows("control")
    caption = (
        "The same demand and seeds. The fixed plan is the net's own; actuated by loops is SUMO's "
        "control with a detector on each lane before the stop bar; perfect counts come from "
        "vehicles that all report exactly where they are, 200 m before the stop bar and 100 m "
        "behind it; tuned, 50 m before it and none behind; queues are those of them that stand. "
        "Webster's fixed plan has the cycle and splits of his formula for this demand."
    )
    blocks = (grid_table(rows, ["controller"], caption), bars(rows, ["controller"], DELAY))
    return Section("Other controllers", blocks)


def _percent(share: float | None) -> float | None:
    return None if share is None else round(100 * share, 1)
