"""The figures that a run is judged by."""

from __future__ import annotations

from studies.page.cells import DASH
from studies.page.model import Cell, Column, Fact, Table
from studies.summary import Summary


def facts(summary: Summary) -> tuple[Fact, ...]:
    """Returns what stands at the top of the page."""
    e_cvpr, delay, uplink = summary["e_cvpr"], summary["delay_s"], summary["uplink_mbps"]
    latency, frames = summary["latency_ms"]["end_to_end"], summary["frames"]
    return (
        Fact(
            "E-CVPR",
            _number(e_cvpr["mean"], 100, 1, " %"),
            _note("s.d. of frames", e_cvpr["std"], 100, " %"),
        ),
        Fact(
            "delay per vehicle",
            _number(delay["mean"], 1, 1, " s"),
            _note("s.d. of vehicles", delay["std"], 1, " s"),
        ),
        Fact(
            "uplink, all agents",
            _number(uplink["mean"], 1, 1, " Mbit/s"),
            _note("peak", uplink["peak"], 1, " Mbit/s"),
        ),
        Fact(
            "sensing to signal, p50",
            _number(latency["p50"], 1, 0, " ms"),
            _note("p95", latency["p95"], 1, " ms"),
        ),
        Fact("frames", f"{frames}", f"{summary['frames_incomplete']} incomplete"),
        Fact("phase switches", str(summary["phases"]["switches"])),
    )


def result_table(summary: Summary) -> Table:
    """Returns the figures of traffic and perception."""
    vehicles, seen = summary["vehicles"], summary["detections_per_frame"]
    rows: tuple[tuple[Cell, Cell], ...] = (
        ("simulated time, s", round(summary["sim_duration_s"], 1)),
        ("real-time factor", _rounded(summary["real_time_factor"])),
        ("vehicles at frame 0", vehicles["at_start"]),
        ("inserted", vehicles["inserted"]),
        ("finished", vehicles["finished"]),
        ("kept outside: no room to enter", vehicles["waiting"]),
        ("teleported", vehicles["teleported"]),
        ("in reach per frame", _rounded(seen["present"])),
        ("truly detected per frame", _rounded(seen["true"])),
        ("false detections per frame", _rounded(seen["false"])),
        ("agents that sent", len(summary["agents"])),
        ("greatest error of clocks, ms", _rounded(summary["clock_error_ms"])),
        ("messages dropped", summary["drops"]),
    )
    return Table((Column("result"), Column("")), rows)


def drop_table(summary: Summary) -> Table | None:
    """Returns what was dropped by process and reason; None if nothing was."""
    rows = tuple(
        (process, reason, times)
        for process, reasons in summary["drops_by_reason"].items()
        for reason, times in reasons.items()
    )
    columns = (Column("process"), Column("reason"), Column("times", "d"))
    return Table(columns, rows, "What was dropped") if rows else None


def lead(summary: Summary) -> str:
    """Returns in a sentence which run this is and how it ended."""
    ended = summary["ended"] or "was cut off"
    words = {"finished": "came to its end", "was cut off": "was cut off"}
    how = words.get(ended, f"ended early: {ended}")
    mode = f" in {summary['mode']}" if summary["mode"] else ""
    seed = f", seed {summary['seed']}" if summary["seed"] is not None else ""
    return f"A run{mode}{seed}, that {how} after {summary['sim_duration_s']:.1f} simulated seconds."


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _number(value: float | None, factor: float, digits: int, unit: str) -> str:
    return DASH if value is None else f"{value * factor:.{digits}f}{unit}"


def _note(word: str, value: float | None, factor: float, unit: str = "") -> str:
    return "" if value is None else f"{word} {value * factor:.1f}{unit}"
