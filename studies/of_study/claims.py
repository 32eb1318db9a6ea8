"""What the experiments are expected to show, and whether they do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from studies.of_study.findings import Findings, Known, number
from studies.page.model import Block, Column, Section, Table, Text

OF_VISIBLE = 0.9
NEAR_PERFECT = 0.10
FLAT_FROM = 0.3
_DETECTOR, _CAV, _CV = "edge.detector", "traffic.cav_rate", "traffic.cv_rate"


@dataclass(frozen=True, slots=True)
class Claim:
    """An expectation, what was measured, and whether that meets it."""

    text: str
    measured: str
    holds: bool


def claims_section(findings: Findings) -> Section:
    """Returns the expectations as a table, first of all that a reader sees."""
    rows = tuple(
        (claim.text, claim.measured, "yes" if claim.holds else "no") for claim in claims(findings)
    )
    columns = (Column("expected"), Column("measured"), Column("holds"))
    blocks: tuple[Block, ...] = (Table(columns, rows), *map(Text, _notes(findings)))
    return Section("What was expected, and what came of it", blocks)


def claims(findings: Findings) -> list[Claim]:
    """Returns the claims that the study's rows can answer."""
    perception = findings.rows("perception")
    detectors = list(dict.fromkeys(str(row[_DETECTOR]) for row in perception))
    found = []
    for detector in detectors:
        rows = sorted(
            (row for row in perception if row[_DETECTOR] == detector),
            key=lambda row: number(row, _CAV) or 0.0,
        )
        found += list(_of_detector(detector, rows, _delay_with(findings, "perfect counts")))
    return found + list(_of_reports(findings.rows("reports")))


def _notes(findings: Findings) -> Iterator[str]:
    """Yields why some figures are not what one would expect, where they are not."""
    perception = findings.rows("perception")
    shares = [(number(row, "e_cvpr_mean"), number(row, "visible_share_mean")) for row in perception]
    if any(found and visible and found > visible for found, visible in shares):
        yield (
            "E-CVPR above the visible share: a vehicle that fewer than 5 points lie on does not "
            "count as visible, but may still be found."
        )
    counts, queues = (_delay_with(findings, name) for name in ("perfect counts", "perfect queues"))
    delays = [delay for row in perception if (delay := number(row, "delay_s_mean")) is not None]
    if counts and delays and min(delays) < counts:
        yield (
            "Less delay than with perfect counts: these are no lower bound for max pressure. The "
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


def _delay_with(findings: Findings, controller: str) -> float | None:
    rows = [row for row in findings.rows("control") if controller in str(row["controller"])]
    return number(rows[0], "delay_s_mean") if rows else None


def _of_detector(name: str, rows: list[Known], perfect_s: float | None) -> Iterator[Claim]:
    rows = [row for row in rows if number(row, "e_cvpr_mean") is not None]
    shares = [number(row, "e_cvpr_mean") or 0.0 for row in rows]
    rising = all(a <= b for a, b in pairwise(shares)) and shares[:1] < shares[-1:]
    listed = ", ".join(f"{100 * share:.1f}" for share in shares)
    yield Claim(f"{name}: E-CVPR rises with the share of CAVs", f"{listed} %", rising)
    of_visible = [
        share / visible
        for row, share in zip(rows, shares, strict=True)
        if (visible := number(row, "visible_share_mean"))
    ]
    if of_visible:
        least = min(of_visible)
        text = f"{name}: E-CVPR is at least {100 * OF_VISIBLE:g} % of the visible share"
        yield Claim(text, f"{100 * least:.1f} % at least", least >= OF_VISIBLE)
    delays = [delay for row in rows if (delay := number(row, "delay_s_mean")) is not None]
    if delays and perfect_s:
        worst = max(delay / perfect_s - 1 for delay in delays)
        text = f"{name}: delay within {100 * NEAR_PERFECT:g} % of that with perfect counts"
        measured = f"{min(delays):.1f} to {max(delays):.1f} s, perfect counts {perfect_s:.1f} s: "
        yield Claim(text, measured + f"{100 * worst:+.1f} % at worst", worst <= NEAR_PERFECT)


def _of_reports(rows: list[Known]) -> Iterator[Claim]:
    """The curve falls, and is flat from a share on: within its own confidence interval."""
    curve = sorted(
        (share, delay, number(row, "delay_s_ci95") or 0.0)
        for row in rows
        if (share := number(row, _CV)) is not None
        and (delay := number(row, "delay_s_mean")) is not None
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
    yield Claim(text, measured, spread <= NEAR_PERFECT * level)
