"""`cpnet up`: from options to a run that ends well, or that says what went wrong."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from cpnet.beside import check_viewing, viewed
from cpnet.crowd import everybody
from cpnet.endpoints import connecting
from cpnet.follow import Attendant, Interruption
from cpnet.preparation import Options, Played, prepared
from cpnet.running import noted
from cpnet.supervisor import Supervisor
from protocol.topics import BusName

if TYPE_CHECKING:
    from cpnet.metrics_page import MetricsAddress, RunMetrics


def up(options: Options, console: Console, played: Played | None = None) -> tuple[int, Path]:
    """Runs the roles of this machine to the end; returns the exit status and the run folder.

    A replay takes the place of the scenario in the options.

    Raises:
        ConfigError: the options or the scenario cannot be.
        MessageError: the roads are too large for a message.
        BusError: the other side cannot be reached.
    """
    check_viewing(options.view)
    address = _metrics_address(options.metrics)
    run = prepared(options, console, played)
    with (
        _serving(address, console) as metrics,
        Interruption() as interruption,
        noted(run.run_dir, run.endpoints, options.keys),
        Supervisor(run.run_dir, run.endpoints, options.log, options.keys) as supervisor,
    ):
        if metrics is not None:
            metrics.expect(run.relays + run.processes, everybody(run.scenario))
        supervisor.start(run.relays + run.processes)
        attendant = Attendant(
            supervisor, run.scenario, interruption, console, options.restart, metrics
        )
        with viewed(run.run_dir, options.view, console):
            status = attendant.attend(connecting(run.endpoints[BusName.WORLD]))
    return status, run.run_dir


def _metrics_address(text: str | None) -> MetricsAddress | None:
    if text is None:
        return None
    from cpnet.metrics_page import MetricsAddress  # prometheus_client slows each other start

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
