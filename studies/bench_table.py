"""The codecs' rows as tables for people, and what they come to."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from rich import box
from rich.console import Console
from rich.table import Table

from studies.bench_codec import FLOOR_BOUND_M, BenchRow

_BLANK = "–"


def print_bench(rows: list[BenchRow], console: Console) -> None:
    """Prints a table for each cloud, then the least favourable ratios of each profile."""
    for name in dict.fromkeys(row.cloud for row in rows):
        console.print(_cloud_table(name, [row for row in rows if row.cloud == name]))
    console.print(_summary_table(rows))
    floors = [row for row in rows if row.noise_floor_bits and row.bound_m == FLOOR_BOUND_M]
    if floors:
        console.print(_floor_table(floors))


def _cloud_table(name: str, rows: list[BenchRow]) -> Table:
    table = Table(
        title=f"{name}, {rows[0].points} points", box=box.SIMPLE_HEAD, title_justify="left"
    )
    for head in ("bound cm", "codec", "bytes", "bits/point", "encode ms", "decode ms", "error cm",
                 "of Draco", "x encode", "x decode"):  # fmt: skip
        table.add_column(head, justify="left" if head == "codec" else "right")
    bound_m = rows[0].bound_m
    for row in rows:
        if row.bound_m != bound_m:
            table.add_section()
            bound_m = row.bound_m
        draco = draco_beside(row, rows)
        ratios = [_BLANK] * 3
        if draco is not None and draco is not row:
            ratios = [f"{ratio(row, draco):.2f}" for ratio in _RATIOS.values()]
        table.add_row(
            f"{100 * row.bound_m:.2f}",
            row.codec,
            str(row.bytes),
            f"{row.bits_per_point:.2f}",
            f"{row.encode_ms:.2f}",
            f"{row.decode_ms:.2f}",
            f"{100 * row.max_error_m:.2f}",
            *ratios,
        )
    return table


def draco_beside(row: BenchRow, rows: Iterable[BenchRow]) -> BenchRow | None:
    """Returns Draco's row on the same cloud with the same error."""
    for other in rows:
        same = other.cloud == row.cloud and other.bound_m == row.bound_m
        if same and other.codec.startswith("draco"):
            return other
    return None


_RATIOS: dict[str, Callable[[BenchRow, BenchRow], float]] = {
    "bytes": lambda row, draco: row.bytes / draco.bytes,
    "encode": lambda row, draco: draco.encode_ms / row.encode_ms,
    "decode": lambda row, draco: draco.decode_ms / row.decode_ms,
}


def _summary_table(rows: list[BenchRow]) -> Table:
    """Beside Draco at equal error: mean and worst over clouds, by codec and bits."""
    table = Table(title="beside Draco", box=box.SIMPLE_HEAD, title_justify="left")
    for head in ("clouds", "codec", "Draco's bits", "bytes", "worst", "x encode", "worst",
                 "x decode", "worst"):  # fmt: skip
        table.add_column(head, justify="right")
    groups: dict[tuple[str, str, str], list[tuple[BenchRow, BenchRow]]] = {}
    for row in rows:
        draco = draco_beside(row, rows)
        if draco is not None and draco is not row:
            kind = "scans" if row.loss_floor_bits is not None else "files"
            key = (kind, row.codec, draco.codec.removeprefix("draco-"))
            groups.setdefault(key, []).append((row, draco))
    for key in sorted(groups, key=lambda key: (key[0] != "scans", key[1], int(key[2]))):
        cells = []
        for name, ratio in _RATIOS.items():
            values = [ratio(row, draco) for row, draco in groups[key]]
            worst = max(values) if name == "bytes" else min(values)
            cells += [f"{sum(values) / len(values):.2f}", f"{worst:.2f}"]
        table.add_row(*key, *cells)
    return table


def _floor_table(rows: list[BenchRow]) -> Table:
    """Bits a point beside what range noise and lost beams must cost."""
    table = Table(
        title=f"above the floor, at a bound of {100 * FLOOR_BOUND_M:g} cm",
        box=box.SIMPLE_HEAD,
        title_justify="left",
    )
    for head in ("cloud", "codec", "bits/point", "noise floor", "x noise", "noise + losses",
                 "x both"):  # fmt: skip
        table.add_column(head, justify="right")
    for row in rows:
        noise = row.noise_floor_bits or 0.0
        both = noise + (row.loss_floor_bits or 0.0)
        table.add_row(
            row.cloud,
            row.codec,
            f"{row.bits_per_point:.2f}",
            f"{noise:.2f}",
            f"{row.bits_per_point / noise:.2f}",
            f"{both:.2f}",
            f"{row.bits_per_point / both:.2f}",
        )
    return table
