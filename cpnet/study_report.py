"""The reports that a study ends with."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import polars as pl

from recorder.versions import versions
from studies.of_study.bandwidth import bandwidth_page
from studies.of_study.findings import Findings
from studies.of_study.paper import paper_page
from studies.of_study.plain import plain_page
from studies.page.model import Page
from studies.page.save import save_html, save_markdown
from studies.sweep.spec import Study

NAME = "report.html"


def write_reports(
    study: Study, frame: pl.DataFrame, folder: Path, markdown: Path | None
) -> Iterator[Path]:
    """Writes the HTML page into the study's folder, and Markdown where it is wanted; yields paths.

    Raises:
        ConfigError: a file cannot be written.
    """
    page = _page(study, frame)
    path = folder / NAME
    save_html(page, path)
    yield path
    if markdown is not None:
        save_markdown(page, markdown)
        yield markdown


def _page(study: Study, frame: pl.DataFrame) -> Page:
    command = shlex.join(["cpnet", *sys.argv[1:]])
    findings = Findings(study, frame, command, versions())
    pages = {"plain": plain_page, "paper": paper_page, "bandwidth": bandwidth_page}
    return pages[study.page](findings)
