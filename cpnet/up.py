"""`cpnet up`: from options to a run that ends well, or that says what went wrong."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from cpnet.beside import check_viewing, viewed
from cpnet.crowd import everybody
from cpnet.endpoints import connecting
from cpnet.exporter.server import Place, serving
from cpnet.follow import Attendant, Interruption
from cpnet.preparation import Options, Played, prepared
from cpnet.running import noted
from cpnet.supervisor import Supervisor
from protocol.topics import BusName


def up(options: Options, console: Console, played: Played | None = None) -> tuple[int, Path]:
    """Runs the roles of this machine to the end; returns the exit status and the run folder.

    A replay takes the place of the scenario in the options.

    Raises:
        ConfigError: the options or the scenario cannot be.
        MessageError: the roads are too large for a message.
        BusError: the other side cannot be reached.
    """
    check_viewing(options.view)
    place = Place.parse(options.metrics) if options.metrics is not None else None
    run = prepared(options, console, played)
    with (
        serving(place) as tally,
        Interruption() as interruption,
        noted(run.run_dir, run.endpoints, options.keys),
        Supervisor(run.run_dir, run.endpoints, options.log, options.keys) as supervisor,
    ):
        if tally is not None:
            tally.expect(run.relays + run.processes, everybody(run.scenario))
            console.print(f"metrics: http://{place}/metrics", highlight=False, soft_wrap=True)
        supervisor.start(run.relays + run.processes)
        attendant = Attendant(
            supervisor, run.scenario, interruption, console, options.restart, tally
        )
        with viewed(run.run_dir, options.view, console):
            status = attendant.attend(connecting(run.endpoints[BusName.WORLD]))
    return status, run.run_dir
