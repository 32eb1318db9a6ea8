"""The command `cpnet`."""

from __future__ import annotations

import logging
import re
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml
from rich.markup import escape

from cpnet import scenario as scenarios
from cpnet.cli_bench import bench_app
from cpnet.cli_doctor import doctor_app
from cpnet.cli_keys import keys_app
from cpnet.cli_learn import learn_app
from cpnet.cli_options import (
    AsJson,
    Connect,
    Insecure,
    Listen,
    Log,
    Only,
    Out,
    Override,
    ServeMetrics,
    UsedKeys,
    View,
    assigned,
    console,
    errors,
)
from cpnet.cli_replay import replay_app
from cpnet.cli_study import study_app
from cpnet.cli_tape import tape_app
from cpnet.cli_view import view_app
from cpnet.conclusion import conclude
from protocol.errors import CpnetError
from protocol.logs import LogStyle

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(doctor_app)
app.add_typer(learn_app)
app.add_typer(study_app)
app.add_typer(keys_app)
app.add_typer(replay_app)
app.add_typer(tape_app)
app.add_typer(view_app)
app.add_typer(bench_app, name="bench")


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"cpnet {version('cpnet-edge')}")
        raise typer.Exit


@app.callback()
def _options(
    _: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="and exit")
    ] = False,
) -> None:
    """Cooperative perception for traffic signals: real bytes, real detection, real delay."""


@app.command("up")
def up_command(  # noqa: PLR0913 - one parameter per option of the command
    scenario: Annotated[str, typer.Argument(help="built-in name or YAML file")] = "t_junction",
    *,
    mode: Annotated[str | None, typer.Option(help="lockstep or realtime")] = None,
    duration: Annotated[float | None, typer.Option(help="simulated s after warm-up")] = None,
    seed: Annotated[int | None, typer.Option(help="of traffic, CAVs, scene and noise")] = None,
    cav_rate: Annotated[float | None, typer.Option(help="share of vehicles with LiDAR")] = None,
    cv_rate: Annotated[float | None, typer.Option(help="share that reports its pose only")] = None,
    net: Annotated[Path | None, typer.Option(help="your own .net.xml")] = None,
    sumocfg: Annotated[Path | None, typer.Option(help="your own .sumocfg")] = None,
    tls: Annotated[str | None, typer.Option(help="id of the signal in that net")] = None,
    link: Annotated[
        str | None, typer.Option(help="uplink of vehicles: 5g-urban, lte, 5mbit,20ms, a trace file")
    ] = None,
    set_: Override = None,
    out: Out = None,
    only: Only = None,
    listen: Listen = None,
    connect: Connect = None,
    record: Annotated[
        bool, typer.Option("--record", help="keep all that is said in RUN/run.mcap, to play again")
    ] = False,
    restart: Annotated[
        bool, typer.Option("--restart", help="start processes again that die; realtime only")
    ] = False,
    metrics: ServeMetrics = None,
    view: View = None,
    log: Log = LogStyle.TEXT,
    keys: UsedKeys = None,
    insecure: Insecure = False,
) -> None:
    """Run the loop: world, sensors, edge, signal, record; then print the summary."""
    from cpnet.preparation import Options
    from cpnet.up import up

    named = {
        "mode": mode,
        "duration_s": duration,
        "seed": seed,
        "traffic.cav_rate": cav_rate,
        "traffic.cv_rate": cv_rate,
        "link.profile": link,
        "traffic.net": _absolute(net),
        "traffic.sumocfg": _absolute(sumocfg),
        "traffic.tls": tls,
        "record.tape": True if record else None,
    }
    own = net or sumocfg
    if own is not None:
        named["name"] = _run_name(own)
    overrides: dict[str, Any] = {k: v for k, v in named.items() if v is not None}
    overrides |= assigned(set_)
    places = listen or [], connect or []
    options = Options(
        scenario, overrides, only, *places, out, restart, metrics, log, keys, insecure, view
    )
    status, run_dir = up(options, console)
    conclude(run_dir)
    raise typer.Exit(status)


def _run_name(file: Path) -> str:
    """Returns a name for runs of a file: what of its own a scenario's name may hold."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", file.name.split(".")[0])[:80] or "own"


@app.command("report")
def report_command(
    run: Annotated[Path, typer.Argument(help="run folder")],
    *,
    as_json: AsJson = False,
    against: Annotated[
        Path | None, typer.Option(help="another run: say which results differ")
    ] = None,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="write a page with charts; works offline")
    ] = None,
) -> None:
    """Print the summary of a run, write it as a page, or compare its results with another run's."""
    from cpnet.again import command_of
    from recorder.compare import differences
    from recorder.run import Run
    from studies.page.write import check_target, save_html
    from studies.run_page import run_page
    from studies.summary import print_report, summarise, to_json

    if html is not None:
        check_target(html, "--html")
        with Run(run) as recorded:
            command = command_of(recorded.scenario)
        save_html(run_page(run, command), html)
        console.print(f"wrote {html}", highlight=False, soft_wrap=True)
        return
    if against is not None:
        found = differences(run, against)
        lines = [str(one) for one in found] or ["the results are the same, row for row"]
        typer.echo("\n".join(lines))
        raise typer.Exit(1 if found else 0)
    summary = summarise(run)
    if as_json:
        typer.echo(to_json(summary))
    else:
        print_report(summary, console)


@app.command("draw")
def draw_command(
    run: Annotated[Path, typer.Argument(help="run folder")],
    *,
    png: Annotated[Path | None, typer.Option(help="default RUN/frame-N.png")] = None,
    frame: Annotated[int | None, typer.Option(help="a recorded frame; default the last")] = None,
) -> None:
    """Draw the merged cloud of a frame with its boxes over the lanes."""
    from studies.snapshot import draw_frame

    console.print(f"wrote {draw_frame(run, frame, png)}", highlight=False, soft_wrap=True)


@app.command("scenario")
def scenario_command(
    name: Annotated[str, typer.Argument(help="built-in name or YAML file")] = "t_junction",
    set_: Override = None,
) -> None:
    """Print a scenario with every key and its value, ready to be edited."""
    data = scenarios.load(name, assigned(set_)).model_dump(mode="json")
    typer.echo(yaml.safe_dump(data, sort_keys=False), nl=False)


def main() -> None:
    """Runs the command; a user's mistake ends with one clear message and status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    try:
        app()
    except CpnetError as error:
        errors.print(f"[bold red]error[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(2)


def _absolute(path: Path | None) -> str | None:
    return str(path.resolve()) if path is not None else None
