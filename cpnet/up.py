"""`cpnet up`: runs the processes of this machine to the end of the run, then prints results."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from cpnet.discovery import discoverable
from cpnet.endpoints import connecting
from cpnet.preparation import Options, Replay, prepare_run
from cpnet.run_monitor import RunMonitor, StopSignals
from cpnet.supervisor import Supervisor
from cpnet.viewer_process import check_viewing, viewed
from cpnet.watch import all_processes
from protocol.topics import BusName

if TYPE_CHECKING:
    from cpnet.metrics_page import MetricsAddress, RunMetrics


def up(options: Options, console: Console, played: Replay | None = None) -> tuple[int, Path]:
    """Runs the roles of this machine to the end; returns the exit status and the run folder.

    A replay replaces the scenario in the options.

    Raises:
        ConfigError: the options or the scenario are invalid.
        MessageError: the roads are too large for a message.
        BusError: the other side cannot be reached.
    """
    check_viewing(options.view)
    address = _metrics_address(options.metrics)
    run = prepare_run(options, console, played)
    with (
        _serving(address, console) as metrics,
        StopSignals() as stop_signals,
        discoverable(run.run_dir, run.endpoints, options.keys),
        Supervisor(run.run_dir, run.endpoints, options.log, options.keys) as supervisor,
    ):
        if metrics is not None:
            metrics.expect(run.relays + run.processes, all_processes(run.scenario))
        supervisor.start(run.relays + run.processes)
        monitor = RunMonitor(
            supervisor, run.scenario, stop_signals, console, options.restart, metrics
        )
        with viewed(run.run_dir, options.view, console):
            status = monitor.follow(connecting(run.endpoints[BusName.WORLD]))
    return status, run.run_dir


def _metrics_address(text: str | None) -> MetricsAddress | None:
    if text is None:
        return None
    from cpnet.metrics_page import MetricsAddress  # prometheus_client would slow every other start

    return MetricsAddress.parse(text)


@contextmanager
def _serving(address: MetricsAddress | None, console: Console) -> Iterator[RunMetrics | None]:
    if address is None:
        yield None
        return
    from cpnet.metrics_page import serving

    with serving(address) as metrics:
        console.print(f"metrics: http://{address}/metrics", highlight=False, soft_wrap=True)
        yield metrics


def print_results(run_dir: Path, console: Console) -> None:
    """Prints the summary of a run that was made here, and hints for next steps."""
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
        f"next: {command} report {shown} --html report.html    {command} draw {shown}",
        highlight=False,
        soft_wrap=True,
    )


def _relative(path: Path) -> Path:
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
