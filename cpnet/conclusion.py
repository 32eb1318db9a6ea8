"""What is said at the end of a run."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from cpnet.cli_options import console


def conclude(run_dir: Path) -> None:
    """Prints the summary of a run that was made here, and what may come next."""
    if not (run_dir / "run.sqlite").is_file():
        console.print("the results are where the role record runs")
        return
    from studies.summary import print_report, summarise

    summary = summarise(run_dir)
    if not summary["frames"]:
        console.print("no frame was recorded")
        return
    print_report(summary, console)
    shown = _relative(run_dir)
    called = Path(sys.argv[0]).absolute()
    is_found = shutil.which("cpnet") is not None or called.name == "__main__.py"
    command = "cpnet" if is_found else _relative(called)
    console.print(
        f"next: {command} draw {shown}    {command} report {shown} --json", soft_wrap=True
    )


def _relative(path: Path) -> Path:
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
