"""The page of the study `paper`: the tables and figures of Chen et al. 2022, theirs beside ours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from studies.of_study import published
from studies.of_study.blocks import DELAY, E_CVPR, bars, curve, grid_table, mean_of
from studies.of_study.claims import claims_section
from studies.of_study.findings import Findings, Known, label_of, number
from studies.of_study.origin import origin_section
from studies.page.charts import Chart, Series
from studies.page.model import Block, Cell, Column, Fact, Page, Section, Table, Text

CAV, CV, DETECTOR = "traffic.cav_rate", "traffic.cv_rate", "edge.detector"
PERFECT = "max pressure, perfect counts"


def paper_page(findings: Findings, sections: Sequence[Section] = ()) -> Page:
    """Returns the page; further sections, such as those of accuracy, stand before the tables."""
    study = findings.study
    duration_s, period_s = (
        float(findings.scenario.get(key, 0)) for key in ("duration_s", "frame_period_s")
    )
    lead = (
        "Chen et al. 2022, A Cooperative Perception Environment for Traffic Operations and "
        f"Control: its tables and figures, from {len(findings.frame)} runs of "
        f"{duration_s:g} s with perception every {period_s:g} s, {len(study.seeds)} seeds a cell. "
        "Theirs come from CARLA's Town04, ours from "
        "another simulator and, where nothing else is said, a generated junction of the same "
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
            origin_section(findings),
        ),
        _facts(findings),
    )


def _facts(findings: Findings) -> tuple[Fact, ...]:
    best = max(findings.rows("perception"), key=lambda r: number(r, CAV) or 0.0, default=None)
    if best is None:
        return ()
    at = f"at {100 * (number(best, CAV) or 0):g} % CAVs, {best[DETECTOR]}"
    pairs = (("E-CVPR, %", E_CVPR), ("mean delay, s", DELAY))
    return tuple(Fact(name, mean_of(best, shown) or "–", at) for name, shown in pairs)


def _e_cvpr_section(findings: Findings) -> Section:
    rows = findings.rows("perception")
    cells = tuple(_e_cvpr_row(row) for row in rows)
    names = ("s.d. over frames", "visible, %", "in range, %", "of the visible, %", "Chen et al., %")
    columns = (
        *map(Column, ("detector", "CAVs, %", "E-CVPR, %")),
        *(Column(name, ".1f") for name in names),
    )
    caption = (
        "Table 2. Vehicles truly detected, of those within 200 m before the stop bar and 100 m "
        "behind it: mean ± half the 95 % confidence interval over seeds. Visible: 5 points or more "
        "in all scans together, or reporting itself. Theirs have standard deviations of 10 to 15."
    )
    blocks: list[Block] = [Table(columns, cells, caption)]
    detectors = list(dict.fromkeys(str(row[DETECTOR]) for row in rows))
    blocks += [_histogram(findings, detector) for detector in detectors]
    return Section("E-CVPR by share of CAVs (Table 2, Figure 8)", tuple(blocks))


def _e_cvpr_row(row: Known) -> tuple[Cell, ...]:
    share, detector = number(row, CAV) or 0.0, str(row[DETECTOR])
    theirs = published.E_CVPR_MEAN.get(published.TWIN.get(detector, ""), {}).get(share)
    found, visible = number(row, "e_cvpr_mean"), number(row, "visible_share_mean")
    return (
        detector,
        label_of(100 * share),
        mean_of(row, E_CVPR),
        _percent(number(row, "e_cvpr_std_mean")),
        _percent(visible),
        _percent(number(row, "in_range_share_mean")),
        None if found is None or not visible else round(100 * found / visible, 1),
        theirs,
    )


def _histogram(findings: Findings, detector: str) -> Chart:
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


def _delay_section(findings: Findings) -> Section:
    rows = findings.rows("perception")
    low, high = published.DELAY_S
    caption = (
        f"Table 3. Time lost on a journey, of all vehicles. Chen et al.: {low} to {high} s in all "
        "cells. Vehicles are means over seeds; kept outside: those that found no room to enter."
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
    return Section("Delay with cooperative perception (Table 3)", tuple(blocks))


def _reports_section(findings: Findings) -> Section:
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


def _level(row: Known, over: Series) -> Series | None:
    mean = number(row, "delay_s_mean")
    if mean is None or not over.x:
        return None
    ends = (over.x[0], over.x[-1])
    return Series(str(row["controller"]), ends, (mean, mean), style="dashed")


def _control_section(findings: Findings) -> Section:
    rows = findings.rows("control")
    caption = (
        "The same demand and seeds. The fixed plan is the net's own; actuated by loops is SUMO's "
        "control with a detector on each lane before the stop bar; perfect counts come from "
        "vehicles that all report exactly where they are; queues are those of them that stand."
    )
    blocks = (grid_table(rows, ["controller"], caption), bars(rows, ["controller"], DELAY))
    return Section("Other controllers", blocks)


def _percent(share: float | None) -> float | None:
    return None if share is None else round(100 * share, 1)
