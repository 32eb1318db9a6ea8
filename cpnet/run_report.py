"""`cpnet report RUN --html FILE`."""

from __future__ import annotations

from pathlib import Path

from cpnet.again import command_of
from recorder.run import Run
from studies.page.write import check_target, save_html
from studies.run_page import run_page


def write_page(run_dir: Path, path: Path) -> Path:
    """Writes the page of a run; returns its path.

    Raises:
        ConfigError: there is no such run, or the file cannot be written.
    """
    check_target(path, "--html")
    with Run(run_dir) as run:
        command = command_of(run.scenario)
    save_html(run_page(run_dir, command), path)
    return path
