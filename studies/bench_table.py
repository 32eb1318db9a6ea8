"""The codecs' rows as tables for people, and what they come to."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from rich import box
from rich.console import Console
from rich.table import Table

from studies.bench_codec import FLOOR_BOUND_M, BenchRow
from studies.whole_table import print_whole

_BLANK = "–"
_NAME_WIDTH = 24


def print_bench(rows: list[BenchRow], console: Console) -> None:
    """Prints a table for each cloud, then the least favourable ratios of each profile."""
    for name in dict.fromkeys(row.cloud for row in rows):
        print_whole(_cloud_table(name, [row for row in rows if row.cloud == name]), console)
    print_whole(_summary_table(rows), console)
    floors = [row for row in rows if row.noise_floor_bits and row.bound_m == FLOOR_BOUND_M]
    if floors:
        print_whole(_floor_table(floors), console)


def _short(name: str) -> str:
    return name if len(name) <= _NAME_WIDTH else f"…{name[1 - _NAME_WIDTH :]}"


def _table(title: str, *heads: str, left: int = 1) -> Table:
    """Returns an empty table; the first `left` columns are words."""
    table = Table(
        title=title,
        box=box.SIMPLE_HEAD,
        title_justify="left",
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    for n, head in enumerate(heads):
        table.add_column(head, justify="left" if n < left else "right", no_wrap=True)
    return table


def _cloud_table(name: str, rows: list[BenchRow]) -> Table:
    table = _table(
        f"{_short(name)}, {rows[0].points} points (of, x: beside Draco at this error)",
        "codec", "bound\ncm", "error\ncm", "bytes", "bits/\npoint", "enc.\nms",
        "dec.\nms", "of\nDraco", "enc.\nx", "dec.\nx",
    )  # fmt: skip
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
            row.codec,
            f"{100 * row.bound_m:.2f}",
            f"{100 * row.max_error_m:.2f}",
            str(row.bytes),
            f"{row.bits_per_point:.2f}",
            f"{row.encode_ms:.2f}",
            f"{row.decode_ms:.2f}",
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
    table = _table(
        "beside Draco at equal maximum error: mean and least favourable cloud",
        "clouds", "codec", "Draco's\nbits", "bytes /\nDraco", "worst", "encode\nx Draco", "worst",
        "decode\nx Draco", "worst", left=2,
    )  # fmt: skip
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
    table = _table(
        f"above the floor, at a bound of {100 * FLOOR_BOUND_M:g} cm",
        "cloud", "codec", "bits/\npoint", "noise\nfloor", "x\nnoise", "noise +\nlosses",
        "x\nboth", left=2,
    )  # fmt: skip
    for row in rows:
        noise = row.noise_floor_bits or 0.0
        both = noise + (row.loss_floor_bits or 0.0)
        table.add_row(
            _short(row.cloud),
            row.codec,
            f"{row.bits_per_point:.2f}",
            f"{noise:.2f}",
            f"{row.bits_per_point / noise:.2f}",
            f"{both:.2f}",
            f"{row.bits_per_point / both:.2f}",
        )
    return table
