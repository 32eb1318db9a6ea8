"""The page of one run: what came of it, over time, by agent, on the map, and how it was made."""

from __future__ import annotations

from pathlib import Path

from protocol.errors import ConfigError
from recorder.run import Run
from studies.ecvpr import FrameScore, score
from studies.of_run.clock import Clock
from studies.of_run.delays import latency_section, latency_table
from studies.of_run.origin import origin_section
from studies.of_run.phases import phases_section
from studies.of_run.places import places_section
from studies.of_run.results import drop_table, facts, lead, result_table
from studies.of_run.uplink import uplink_section
from studies.of_run.vehicles import vehicles_section
from studies.page.model import Beside, Block, Page, Section, Text
from studies.summary import Summary, summarise


def run_page(run_dir: Path, command: str = "") -> Page:
    """Returns the page of a run, be it whole, cut off or empty.

    Args:
        run_dir: the run's folder.
        command: what makes the run again; empty if that is not known.

    Raises:
        ConfigError: the folder is no run.
    """
    summary = summarise(run_dir)
    with Run(run_dir) as run:
        clock = Clock.of(run)
        sections = (
            Section(
                "Results",
                (
                    Beside((result_table(summary), latency_table(summary["latency_ms"]))),
                    _drops(summary),
                ),
            ),
            vehicles_section(run, clock, _scores(run)),
            phases_section(run, clock),
            uplink_section(run, clock),
            latency_section(run, clock, summary["latency_ms"]),
            places_section(run, clock),
            origin_section(run, command),
        )
        name = str(summary["scenario"] or run_dir.name)
    return Page(name, lead(summary), sections, facts(summary))


def _scores(run: Run) -> list[FrameScore]:
    try:
        return score(run)
    except ConfigError:  # killed before its setup was written, or moved without it
        return []


def _drops(summary: Summary) -> Block:
    return drop_table(summary) or Text("Nothing was dropped.")
