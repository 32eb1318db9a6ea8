"""Two runs side by side: their settings that differ, their measures, and by how much."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from recording.run import Run
from studies.bench import empty_table, print_whole
from studies.summary import Summary, summarise


@dataclass(frozen=True, slots=True)
class Metric:
    """A figure of a run's summary: its name, its path, unit and digits."""

    name: str
    unit: str
    digits: int
    of: Callable[[Summary], float | None]


def _at(*keys: str, factor: float = 1.0) -> Callable[[Summary], float | None]:
    def find(summary: Summary) -> float | None:
        value: Any = summary
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return None if value is None else factor * float(value)

    return find


METRICS = (
    Metric("delay per vehicle", "s", 2, _at("delay_s", "mean")),
    Metric("delay, p95", "s", 1, _at("delay_s", "p95")),
    Metric("stops per vehicle", "", 2, _at("stops")),
    Metric("CO2 per vehicle", "g", 0, _at("co2_g")),
    Metric("E-CVPR", "%", 1, _at("e_cvpr", "mean", factor=100)),
    Metric("false detections a frame", "", 2, _at("detections_per_frame", "false")),
    Metric("uplink of all agents", "Mbit/s", 2, _at("uplink_mbps", "mean")),
    Metric("uplink, peak", "Mbit/s", 2, _at("uplink_mbps", "peak")),
    Metric("end-to-end latency, p50", "ms", 1, _at("latency_ms", "end_to_end", "p50")),
    Metric("end-to-end latency, p95", "ms", 1, _at("latency_ms", "end_to_end", "p95")),
    Metric("vehicles that arrived", "", 0, _at("vehicles", "finished")),
    Metric("vehicles that wait to enter", "", 0, _at("vehicles", "waiting")),
    Metric("changes of green", "", 0, _at("phases", "switches")),
    Metric("frames", "", 0, _at("frames")),
    Metric("incomplete frames", "", 0, _at("frames_incomplete")),
    Metric("messages dropped", "", 0, _at("drops")),
)


_NONE = "–"
_MOST_CHARS = 40  # of a value that is shown


def print_comparison(run: Path, other: Path, console: Console) -> None:
    """Prints tables of the settings that differ and of both runs' measures.

    A measure that neither has is left out.

    Raises:
        ConfigError: one of the folders is no run.
    """
    summaries = summarise(run), summarise(other)
    settings = differing_settings(run, other)
    if settings:
        listed = empty_table(("setting", run.name, other.name), left=3)
        for row in settings:
            listed.add_row(*(escape(_shortened(text)) for text in row))
        print_whole(listed, console)
    table = empty_table(("", run.name, other.name, "difference", ""))
    for metric in METRICS:
        a, b = (metric.of(summary) for summary in summaries)
        if a is None and b is None:
            continue
        unit = f" in {metric.unit}" if metric.unit else ""
        numbers = [_number(a, metric.digits), _number(b, metric.digits)]
        table.add_row(f"{metric.name}{unit}", *numbers, *_difference(a, b, metric.digits))
    print_whole(table, console)


def differing_settings(run: Path, other: Path) -> list[tuple[str, str, str]]:
    """Returns the keys of the scenarios that differ, and both values as JSON has them."""
    with Run(run) as one, Run(other) as two:
        own, others = dict(_flat(one.scenario)), dict(_flat(two.scenario))
    keys = [key for key in {**own, **others} if own.get(key) != others.get(key)]
    return [(key, own.get(key, _NONE), others.get(key, _NONE)) for key in keys]


def _flat(section: dict[str, Any], path: str = "") -> Iterator[tuple[str, str]]:
    for name, value in section.items():
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{path}{name}.")
        else:
            yield f"{path}{name}", json.dumps(value, ensure_ascii=False)


def _shortened(text: str) -> str:
    return text if len(text) <= _MOST_CHARS else f"{text[:_MOST_CHARS]}…"


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _difference(a: float | None, b: float | None, digits: int) -> tuple[str, str]:
    """Returns how much the first is more than the second, and that in % of the second."""
    if a is None or b is None:
        return "", ""
    if a == b:
        return "0", ""
    return f"{a - b:+.{digits}f}", f"{100 * (a - b) / abs(b):+.1f} %" if b else ""
