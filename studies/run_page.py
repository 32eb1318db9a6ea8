"""The page of one run: results, counts, signal, uplink, latency, map, and how it was made."""

from __future__ import annotations

import json
from pathlib import Path

import yaml

from recording.run import Run
from studies.city_section import city_section
from studies.latency import latency_section, latency_table
from studies.over_time import FrameClock
from studies.page.model import (
    DASH,
    Block,
    Cell,
    Code,
    Column,
    Fact,
    Page,
    Section,
    SideBySide,
    Table,
    Text,
)
from studies.run_sections import map_section, phases_section, vehicles_section
from studies.summary import Summary, scores_of, summary_of
from studies.uplink import uplink_section

MIN_JUNCTIONS = 2  # that are compared


def facts(summary: Summary) -> tuple[Fact, ...]:
    """Returns the headline figures at the top of the page."""
    e_cvpr, delay, uplink = summary["e_cvpr"], summary["delay_s"], summary["uplink_mbps"]
    latency = summary["latency_ms"]["end_to_end"]
    shown = (
        ("E-CVPR", e_cvpr["mean"], "s.d. of frames", e_cvpr["std"], 100, 1, " %"),
        ("delay per vehicle", delay["mean"], "s.d. of vehicles", delay["std"], 1, 1, " s"),
        ("uplink, all agents", uplink["mean"], "peak", uplink["peak"], 1, 1, " Mbit/s"),
        ("sensing to signal, p50", latency["p50"], "p95", latency["p95"], 1, 0, " ms"),
    )
    return (
        *(
            Fact(name, _number(value, factor, digits, unit), _note(word, beside, factor, unit))
            for name, value, word, beside, factor, digits, unit in shown
        ),
        Fact("frames", f"{summary['frames']}", f"{summary['frames_incomplete']} incomplete"),
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
        ("not inserted: no room to enter", vehicles["waiting"]),
        ("teleported", vehicles["teleported"]),
        ("delay, p95, s", _rounded(summary["delay_s"]["p95"])),
        ("stops per vehicle", _rounded(summary["stops"])),
        ("CO2 per vehicle by SUMO's model, g", _rounded(summary["co2_g"])),
        ("near the signal per frame", _rounded(seen["present"])),
        ("truly detected per frame", _rounded(seen["true"])),
        ("false detections per frame", _rounded(seen["false"])),
        *_track_rows(summary["tracks"]),
        ("agents that sent", len(summary["agents"])),
        ("largest clock error, ms", _rounded(summary["clock_error_ms"])),
        ("messages dropped", summary["drops"]),
    )
    return Table((Column("result"), Column("")), rows)


def _track_rows(tracks: Summary | None) -> tuple[tuple[str, Cell], ...]:
    """Returns rows on the effect of coasting tracks, if there are any."""
    if tracks is None or tracks["precision"] is None:
        return ()
    e_cvpr, precision = tracks["e_cvpr"], tracks["precision"]
    shown = (
        ("E-CVPR without tracks that coast, %", e_cvpr["observed"]),
        ("precision of observed boxes, %", precision["observed"]),
        ("precision of boxes of tracks that coast, %", precision["coasted"]),
    )
    shares = tuple((name, _rounded(share and 100 * share)) for name, share in shown)
    return (("tracks", tracks["tracks"]), *shares)


def drop_table(summary: Summary) -> Table | None:
    """Returns drops by process and reason; None without any."""
    rows = tuple(
        (process, reason, times)
        for process, reasons in summary["drops_by_reason"].items()
        for reason, times in reasons.items()
    )
    columns = (Column("process"), Column("reason"), Column("times", "d"))
    return Table(columns, rows, "Dropped messages") if rows else None


def lead_sentence(summary: Summary) -> str:
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


def _note(word: str, value: float | None, factor: float, unit: str) -> str:
    return "" if value is None else f"{word} {value * factor:.1f}{unit}"


def origin_section(run: Run, command: str) -> Section:
    """Returns the section on reproducing the run: command, versions, scenario."""
    blocks: list[Block] = []
    if command:
        blocks.append(Code(command, "The command that makes this run again"))
    else:
        blocks.append(Text("The command is not known: this version does not take the scenario."))
    rows = _versions(run)
    blocks.append(Table((Column("made with"), Column("version")), rows))
    if run.scenario:
        text = yaml.safe_dump(run.scenario, sort_keys=False, allow_unicode=True)
        blocks.append(Code(text, "The scenario, with every default", folded=True))
    else:
        blocks.append(Text("No scenario was recorded."))
    return Section("How it was made", tuple(blocks))


def _versions(run: Run) -> tuple[tuple[Cell, ...], ...]:
    try:
        found = json.loads(run.meta.get("versions", "{}"))
    except ValueError:
        found = {}
    if not isinstance(found, dict) or not found:  # a run from before all of them were kept
        found = {"cpnet-edge": run.meta.get("version", "unknown")}
    started = run.meta.get("started")
    return (
        *((str(k), str(v)) for k, v in found.items()),
        *([("started", started)] if started else []),
    )


def run_page(run_dir: Path, command: str = "") -> Page:
    """Returns the page of a run, be it whole, cut off or empty.

    Args:
        run_dir: the run's folder.
        command: the command that reproduces the run; empty if unknown.

    Raises:
        ConfigError: the folder is no run.
    """
    from studies.trajectory_section import trajectory_section  # needs Polars, as a page does

    with Run(run_dir) as run:
        scores = scores_of(run)
        summary = summary_of(run, scores)
        clock = FrameClock.of(run)
        sections = (
            Section(
                "Results",
                (
                    SideBySide((result_table(summary), latency_table(summary["latency_ms"]))),
                    _drops(summary),
                ),
            ),
            *_city(run, summary),
            vehicles_section(run, clock, scores),
            phases_section(run, clock),
            trajectory_section(run),
            uplink_section(run, clock),
            latency_section(run, clock, summary["latency_ms"]),
            map_section(run),
            origin_section(run, command),
        )
        name = str(summary["scenario"] or run_dir.name)
    return Page(name, lead_sentence(summary), sections, facts(summary))


def _city(run: Run, summary: Summary) -> tuple[Section, ...]:
    """Returns the section of junctions and regions; of a run with one, its figures stand above."""
    if len(summary["junctions"]) < MIN_JUNCTIONS:
        return ()
    return (city_section(run, summary["junctions"], summary["regions"]),)


def _drops(summary: Summary) -> Block:
    return drop_table(summary) or Text("Nothing was dropped.")
