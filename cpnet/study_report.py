"""The reports that a study ends with."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl

from recorder.versions import versions
from studies.accuracy.kept import accuracy_of
from studies.accuracy.scenes import scenes_section
from studies.accuracy.table import accuracy_section
from studies.page.model import Section
from studies.page.write import save_html, save_markdown
from studies.paper_page import paper_page
from studies.study_page import bandwidth_page, plain_page
from studies.study_tables import StudyResults
from studies.sweep.study_file import Accuracy, Study

NAME = "report.html"
PAGES = {"plain": plain_page, "paper": paper_page, "bandwidth": bandwidth_page}


def write_reports(
    study: Study,
    scenario: dict[str, Any],
    frame: pl.DataFrame,
    missing: tuple[str, ...],
    folder: Path,
    markdown: Path | None,
) -> Iterator[Path]:
    """Writes the HTML page into the study's folder, and Markdown where it is wanted; yields paths.

    Args:
        study: with what was set on the command line.
        scenario: what its cells have in common, with every key.
        frame: the study's table.
        missing: titles of cells that it lacks.
        folder: of its results.
        markdown: a file; its figures go beside it.

    Raises:
        ConfigError: a file cannot be written, or a detector cannot be had here.
    """
    command = shlex.join(["cpnet", *sys.argv[1:]])
    findings = StudyResults(study, frame, command, versions(), scenario, missing)
    page = PAGES[study.page](findings, _accuracy(study.accuracy, scenario, folder))
    path = folder / NAME
    save_html(page, path)
    yield path
    if markdown is not None:
        save_markdown(page, markdown)
        yield markdown


def _accuracy(spec: Accuracy | None, scenario: dict[str, Any], folder: Path) -> tuple[Section, ...]:
    if spec is None:
        return ()
    rows = accuracy_of(scenario, spec.detectors, spec.samples, folder)
    best = spec.detectors[-1]
    return accuracy_section(rows), scenes_section(scenario, best)
