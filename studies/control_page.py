"""The page of `cpnet study control`, and its table on a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from studies.bench import empty_table, print_whole
from studies.control_file import NETS, ControlStudy
from studies.page.model import (
    DASH,
    Block,
    Chart,
    Code,
    Column,
    Page,
    Section,
    Series,
    Table,
    text_rows,
)

Row = dict[str, Any]
_HEADS = (
    *("policy", "what its tuning set", "delay, s", "95th percentile, s", "longest wait, s"),
    *("stops", "CO2, g", "arrived", "difference, s", "difference, %"),
)
_PERCEIVED_HEADS = "E-CVPR, %", "uplink, Mbit/s"


def control_page(
    study: ControlStudy, rows: Sequence[Row], command: str, versions: dict[str, str]
) -> Page:
    """Returns a section for each net and demand, best policy first, and what was run."""
    groups = groups_of(rows)
    seen = f", but for {_listed(study.perceived)}, with perception" if study.perceived else ""
    lead = (
        "SUMO alone: every policy is given the true places of the vehicles near the signals"
        f"{seen}. Delay is time loss plus departure delay of all vehicles, those still on the way "
        f"and those kept outside as well, a mean over {len(study.seeds)} seeds ± half the width of "
        f"its 95 % interval. A difference is that of {study.studied} to the control, seed by seed; "
        "one within its interval cannot be told from none. "
    )
    again = f", the best {study.finals} again for as long as the reported runs"
    again = again if study.finals > 1 else ""
    lead += (
        f"Each baseline is tuned for each net and demand on seeds {_listed(study.tuning_seeds)}, "
        f"{study.tuning_duration_s:,d} s each{again}; seeds {_listed(study.seeds)} are reported."
        if study.tuning_seeds
        else "Nothing is tuned."
    )
    charts: list[Block] = [
        _chart(net, study.policies, part) for net in study.nets if (part := _steady(rows, net))
    ]
    sections = [Section("Delay over demand", tuple(charts))] if charts else []
    sections += [Section(title, (group_table(part),)) for title, part in groups.items()]
    return Page(study.title or study.name, lead, (*sections, _origin(study, command, versions)))


def groups_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Returns the rows by net and demand, those of least delay first."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        factor = f" x{row['demand']:g}" if row["net"] in NETS else ""
        found.setdefault(row["net"] + factor, []).append(row)
    return {title: sorted(part, key=lambda row: row["delay_s"]) for title, part in found.items()}


def group_table(rows: Sequence[Row]) -> Table:
    """Returns a line for each policy."""
    is_perceived = any(row["e_cvpr"] is not None for row in rows)
    cells = tuple(
        (
            row["policy"],
            row["setting"] or None,
            _with_half(row["delay_s"], row["delay_ci95_s"]),
            row["delay_p95_s"],
            row["waited_s"],
            row["stops"],
            row["co2_g"],
            f"{row['arrived']:.0f} of {row['vehicles']:.0f}",
            _with_half(row["difference_s"], row["difference_ci95_s"], "+"),
            None if row["difference_share"] is None else 100 * row["difference_share"],
            *(_perceived(row) if is_perceived else ()),
        )
        for row in rows
    )
    heads = (*_HEADS, *(_PERCEIVED_HEADS if is_perceived else ()))
    forms = ("", "", "", ".1f", ".0f", ".2f", ".0f", "", "", "+.0f", ".1f", ".2f")
    return Table(tuple(map(Column, heads, forms)), cells)


def _perceived(row: Row) -> tuple[float | None, float | None]:
    share: float | None = row["e_cvpr"]
    return None if share is None else 100 * share, row["uplink_mbps"]


def print_control_study(rows: Sequence[Row], console: Console) -> None:
    """Prints a table for each net and demand."""
    for title, part in groups_of(rows).items():
        found = group_table(part)
        table = empty_table([one.name for one in found.columns], title=title, left=2)
        for cells in text_rows(found):
            table.add_row(*cells)
        print_whole(table, console)


def _with_half(mean: float | None, half: float | None, sign: str = "") -> str | None:
    if mean is None:
        return None
    text = f"{mean:{sign}.2f}"
    return text if half is None else f"{text} ± {half:.2f}"


def _steady(rows: Sequence[Row], net: str) -> list[Row]:
    """Returns the rows of a net with several demands."""
    found = [row for row in rows if row["net"] == Path(net).name]
    return found if len({row["demand"] for row in found}) > 1 else []


def _chart(net: str, policies: Sequence[str], rows: Sequence[Row]) -> Chart:
    series = []
    for policy in policies:
        own = sorted((row for row in rows if row["policy"] == policy), key=lambda r: r["demand"])
        x = tuple(row["demand"] for row in own)
        series.append(Series(policy, x, tuple(r["delay_s"] for r in own), style="line+points"))
    return Chart(f"Mean delay on {net}", "factor of the demand", "mean delay, s", tuple(series))


def _origin(study: ControlStudy, command: str, versions: dict[str, str]) -> Section:
    text = yaml.safe_dump(study.model_dump(), sort_keys=False, allow_unicode=True)
    blocks: list[Block] = [Code(command, "The command that makes this again")]
    if versions:
        blocks.append(Table((Column("made with"), Column("version")), tuple(versions.items())))
    blocks.append(Code(text, "The study, with what was set on the command line", folded=True))
    return Section("How it was made", tuple(blocks))


def _listed(values: Iterable[object]) -> str:
    return ", ".join(map(str, values)) or DASH
