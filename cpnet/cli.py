"""The command `cpnet`."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar

import typer
import yaml
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    track,
)

from cpnet import doctor as checks
from cpnet import scenario as scenarios
from cpnet.bench import LINK_CHOICES, POLICY_CHOICES, UplinkBench, measure, measure_rates
from cpnet.up import Options, up
from perception.config import DETECTORS
from protocol.errors import CpnetError
from recorder.compare import differences
from studies.bench_traffic import FRAME_PERIOD_S
from studies.bench_uplink import LEARNING_FRAMES
from studies.report import print_report
from studies.summary import summarise, to_json
from studies.uplink_table import print_rates, print_uplink

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
bench_app = typer.Typer(help="Measure parts of the system.", no_args_is_help=True)
app.add_typer(bench_app, name="bench")
_console = Console()
_errors = Console(stderr=True)

Override = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="any scenario key; `cpnet scenario` shows all"),
]
AsJson = Annotated[bool, typer.Option("--json", help="stable keys, for programs")]
Policies = Annotated[str, typer.Option(metavar="NAME[+FILTER],...", help="upload policies")]
Agents = Annotated[int, typer.Option(help="a roadside LiDAR and CAVs")]
Frames = Annotated[
    int, typer.Option(help=f"frames of each run; the first {LEARNING_FRAMES} do not count")
]
_ADDRESS = "HOST:PORT, v2x=HOST:PORT or world=HOST:PORT"
_ALL_POLICIES = ",".join(POLICY_CHOICES)


class Row(Protocol):
    """A row of a bench."""

    def as_json(self) -> dict[str, Any]:
        """Returns its figures by stable keys."""


R = TypeVar("R", bound=Row)


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
    netns: Annotated[
        bool, typer.Option("--netns", help="links by a network namespace per agent; needs root")
    ] = False,
    set_: Override = None,
    out: Annotated[Path | None, typer.Option(help="run folder; default runs/NAME-TIME")] = None,
    only: Annotated[str | None, typer.Option(metavar="ROLE,...", help="roles to run here")] = None,
    listen: Annotated[
        list[str] | None, typer.Option(metavar="PLACE", help=f"host the buses: {_ADDRESS}")
    ] = None,
    connect: Annotated[
        list[str] | None, typer.Option(metavar="PLACE", help=f"buses elsewhere: {_ADDRESS}")
    ] = None,
) -> None:
    """Run the loop: world, sensors, edge, signal, record; then print the summary."""
    named = {
        "mode": mode,
        "duration_s": duration,
        "seed": seed,
        "traffic.cav_rate": cav_rate,
        "traffic.cv_rate": cv_rate,
        "link.profile": link,
        "link.apply": "netns" if netns else None,
        "traffic.net": _absolute(net),
        "traffic.sumocfg": _absolute(sumocfg),
        "traffic.tls": tls,
    }
    own = net or sumocfg
    if own is not None:
        named["name"] = _run_name(own)
    overrides: dict[str, Any] = {k: v for k, v in named.items() if v is not None}
    overrides |= _assigned(set_)
    options = Options(scenario, overrides, only, listen or [], connect or [], out)
    status, run_dir = up(options, _console)
    _conclude(run_dir)
    raise typer.Exit(status)


def _run_name(file: Path) -> str:
    """Returns a name for runs of a file: what of its own a scenario's name may hold."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", file.name.split(".")[0])[:80] or "own"


def _conclude(run_dir: Path) -> None:
    if not (run_dir / "run.sqlite").is_file():
        _console.print("the results are where the role record runs")
        return
    summary = summarise(run_dir)
    if not summary["frames"]:
        _console.print("no frame was recorded")
        return
    print_report(summary, _console)
    shown = _relative(run_dir)
    command = "cpnet" if shutil.which("cpnet") else _relative(Path(sys.argv[0]).absolute())
    _console.print(
        f"next: {command} draw {shown}    {command} report {shown} --json", soft_wrap=True
    )


@app.command("report")
def report_command(
    run: Annotated[Path, typer.Argument(help="run folder")],
    *,
    as_json: AsJson = False,
    against: Annotated[
        Path | None, typer.Option(help="another run: say which results differ")
    ] = None,
) -> None:
    """Print the summary of a run, or compare its results with another run's."""
    if against is not None:
        found = differences(run, against)
        lines = [str(one) for one in found] or ["the results are the same, row for row"]
        typer.echo("\n".join(lines))
        raise typer.Exit(1 if found else 0)
    summary = summarise(run)
    if as_json:
        typer.echo(to_json(summary))
    else:
        print_report(summary, _console)


@app.command("draw")
def draw_command(
    run: Annotated[Path, typer.Argument(help="run folder")],
    *,
    png: Annotated[Path | None, typer.Option(help="default RUN/frame-N.png")] = None,
    frame: Annotated[int | None, typer.Option(help="a recorded frame; default the last")] = None,
) -> None:
    """Draw the merged cloud of a frame with its boxes over the lanes."""
    from studies.draw import draw_frame

    _console.print(f"wrote {draw_frame(run, frame, png)}", highlight=False, soft_wrap=True)


@app.command("scenario")
def scenario_command(
    name: Annotated[str, typer.Argument(help="built-in name or YAML file")] = "t_junction",
    set_: Override = None,
) -> None:
    """Print a scenario with every key and its value, ready to be edited."""
    data = scenarios.load(name, _assigned(set_)).model_dump(mode="json")
    typer.echo(yaml.safe_dump(data, sort_keys=False), nl=False)


@app.command("dataset")
def dataset_command(
    out: Annotated[Path, typer.Argument(help="a new or empty folder")],
    *,
    networks: Annotated[int, typer.Option(help="generated junctions")] = 60,
    moments: Annotated[int, typer.Option(help="of each network, some seconds apart")] = 12,
    seed: Annotated[int, typer.Option(help="the same bytes for the same seed")] = 1,
    jobs: Annotated[int | None, typer.Option(help="processes; default one a core")] = None,
) -> None:
    """Write labelled scans of many generated junctions, for training."""
    from learning.generate import Asked, generate

    asked = Asked(networks=networks, moments=moments, seed=seed)
    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()]
    with Progress(*columns, TimeElapsedColumn(), console=_errors, transient=True) as progress:
        task = progress.add_task("networks", total=networks)

        def report(done: int, scans: int) -> None:
            progress.update(task, completed=done, description=f"networks, {scans} scans")

        generate(out, asked, (os.cpu_count() or 1) if jobs is None else jobs, report)
    _console.print(f"wrote {out}", highlight=False, soft_wrap=True)


@app.command("train")
def train_command(
    dataset: Annotated[Path, typer.Argument(help="a folder that `cpnet dataset` wrote")],
    *,
    out: Annotated[Path, typer.Option(help="for weights and state; training goes on from there")],
    network: Annotated[
        str, typer.Option(help="pointpillars or pointpillars-full")
    ] = "pointpillars",
    steps: Annotated[int, typer.Option(help="of the optimiser")] = 20_000,
    windows: Annotated[int, typer.Option(help="a step")] = 4,
    cells: Annotated[int, typer.Option(help="of 0.25 m, a window's side")] = 320,
    seed: Annotated[int, typer.Option(help="the same weights for the same seed")] = 1,
) -> None:
    """Train PointPillars on labelled scans, on a GPU if there is one."""
    from learning.train import Training, train
    from learning.training import Recipe

    recipe = Recipe(steps=steps, windows=windows, cells=cells, seed=seed)
    path = train(Training(dataset, out, network, recipe), _errors)
    _console.print(f"wrote {path}", highlight=False, soft_wrap=True)


@app.command("eval")
def eval_command(
    dataset: Annotated[
        Path | None, typer.Argument(help="a folder that `cpnet dataset` wrote")
    ] = None,
    *,
    net: Annotated[Path | None, typer.Option(help="instead: your own .net.xml")] = None,
    tls: Annotated[str | None, typer.Option(help="id of the signal in that net")] = None,
    detectors: Annotated[
        str, typer.Option(metavar="NAME,...", help=f"of {', '.join(DETECTORS)}")
    ] = "fast",
    split: Annotated[str, typer.Option(help="of the dataset: train, val or test")] = "test",
    moments: Annotated[int, typer.Option(min=1, max=500, help="of your own net")] = 12,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="a key of `edge`")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure detectors beside the truth: AP40, recall, precision, beside the paper's."""
    from cpnet.evaluation import Source, detectors_of
    from studies.evaluate import evaluate
    from studies.evaluate_table import print_evaluation

    names = detectors_of(detectors)
    config = scenarios.load("t_junction", _assigned(set_)).edge
    count, listed = Source(dataset, net, tls, split, moments).open(config)
    shown = track(listed, "measuring", count, console=_errors, transient=True)
    rows = evaluate(shown, names)
    _show(rows, print_evaluation, as_json=as_json)


@app.command("doctor")
def doctor_command(
    *,
    packages: Annotated[
        bool, typer.Option("--packages", help="print the missing system packages only")
    ] = False,
) -> None:
    """Check this machine: system libraries, packages, bus, disk."""
    if packages:
        typer.echo(" ".join(checks.missing_packages()))
        return
    findings = checks.examine()
    checks.print_findings(findings, _console)
    raise typer.Exit(0 if all(one.ok or one.optional for one in findings) else 1)


@bench_app.command("codec")
def bench_codec_command(
    *,
    points: Annotated[
        list[Path] | None,
        typer.Option(metavar="PATH", help="a .bin or .pcd file as well, or all in a folder"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the scan codec beside Draco and zstd at equal maximum error."""
    from protocol.codec.draco import load_draco
    from sensing.point_files import point_files
    from studies.bench_codec import BenchCloud, bench
    from studies.bench_scans import cast_scans
    from studies.bench_table import print_bench

    load_draco()
    files = [BenchCloud.of_file(path) for path in point_files(points or [])]
    clouds = [BenchCloud.of_scan(scan) for scan in cast_scans()] + files
    rows = [row for cloud in clouds for row in bench(cloud)]
    _show(rows, print_bench, as_json=as_json)


@bench_app.command("uplink")
def bench_uplink_command(
    *,
    policies: Policies = _ALL_POLICIES,
    link: Annotated[
        list[str] | None, typer.Option(help="uplink of all agents; may be given several times")
    ] = None,
    agents: Agents = 6,
    frames: Frames = 60,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="emulated links and the wall clock")
    ] = False,
    rate: Annotated[float, typer.Option(min=1, max=100, help="realtime: frames a second")] = 10,
    as_json: AsJson = False,
) -> None:
    """Measure upload policies on links: bytes, latency, what is still detected and counted."""
    bench = UplinkBench(
        policies=tuple(policies.split(",")),
        links=tuple(link or LINK_CHOICES),
        agents=agents,
        frames=frames,
        realtime=realtime,
        rate_hz=rate if realtime else 1 / FRAME_PERIOD_S,
    )
    cells = len(bench.policies) * len(bench.links)
    rows = list(track(measure(bench), "measuring", cells, console=_errors, transient=True))
    _show(rows, print_uplink, as_json=as_json)


@bench_app.command("rate")
def bench_rate_command(
    *,
    policies: Policies = "full,foreground,reap+foreground",
    agents: Agents = 6,
    frames: Frames = 120,
    as_json: AsJson = False,
) -> None:
    """Find the highest frame rate in realtime, with detection, on recorded scans."""
    bench = UplinkBench(policies=tuple(policies.split(",")), agents=agents, frames=frames)
    rows = list(track(measure_rates(bench), "measuring", None, console=_errors, transient=True))
    _show(rows, print_rates, as_json=as_json)


def _show(rows: list[R], print_table: Callable[[list[R], Console], None], *, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps([row.as_json() for row in rows], indent=2))
    else:
        print_table(rows, _console)


def main() -> None:
    """Runs the command; a user's mistake ends with one clear message and status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    try:
        app()
    except CpnetError as error:
        _errors.print(f"[bold red]error[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(2)


def _assigned(texts: list[str] | None) -> dict[str, Any]:
    return dict(scenarios.parse_assignment(text) for text in texts or [])


def _relative(path: Path) -> Path:
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _absolute(path: Path | None) -> str | None:
    return str(path.resolve()) if path is not None else None
