"""The command `cpnet`."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer
import yaml
from rich.markup import escape

from cpnet import scenario as scenarios
from cpnet.cli_bench import bench_app
from cpnet.cli_compare import compare_app
from cpnet.cli_learn import learn_app
from cpnet.cli_observe import recording_app, view_app
from cpnet.cli_options import (
    AsJson,
    Override,
    assigned,
    console,
    errors,
)
from cpnet.cli_run import run_app
from cpnet.cli_setup import doctor_app, keys_app
from cpnet.cli_study import study_app
from cpnet.run_folder import newest_run
from protocol.errors import ConfigError, CpnetError
from protocol.extras import to_install

RecordedRun = Annotated[
    Path | None, typer.Argument(help="run folder; default the newest run in runs/")
]
app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(doctor_app)
app.add_typer(learn_app)
app.add_typer(study_app)
app.add_typer(compare_app)
app.add_typer(keys_app)
app.add_typer(run_app)
app.add_typer(recording_app)
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


@app.command("report")
def report_command(
    run: RecordedRun = None,
    *,
    as_json: AsJson = False,
    against: Annotated[
        Path | None, typer.Option(help="another run: both side by side, and which rows differ")
    ] = None,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="write a page with charts; works offline")
    ] = None,
    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE.md", help="the same as Markdown, charts as PNG")
    ] = None,
    trajectories: Annotated[
        Path | None, typer.Option(metavar="FILE.parquet", help="write where every track was, when")
    ] = None,
) -> None:
    """Print the summary of a run, write it as a page, or compare its results with another run's."""
    from recording.run import differences
    from studies.comparison import print_comparison
    from studies.summary import print_report, summarise, to_json

    run = run or newest_run()
    if trajectories is not None:
        _write_trajectories(run, trajectories)
        return
    if html is not None or markdown is not None:
        _write_pages(run, html, markdown)
        return
    if against is not None:
        found = differences(run, against)
        print_comparison(run, against, console)
        lines = [str(one) for one in found] or ["the results are the same, row for row"]
        typer.echo("\n".join(lines))
        raise typer.Exit(1 if found else 0)
    summary = summarise(run)
    if as_json:
        typer.echo(to_json(summary))
    else:
        print_report(summary, console)


def _write_pages(run: Path, html: Path | None, markdown: Path | None) -> None:
    """Writes a run's page in the forms that are asked for."""
    from cpnet.reproduce import command_of
    from recording.run import Run
    from studies.page.write import check_target, save_html, save_markdown
    from studies.run_page import run_page

    forms = (("--html", html, save_html), ("--markdown", markdown, save_markdown))
    asked = [(option, path, save) for option, path, save in forms if path is not None]
    for option, path, _ in asked:
        check_target(path, option)
    with Run(run) as recorded:
        command = command_of(recorded.scenario)
    page = run_page(run, command)
    for _, path, save in asked:
        save(page, path)
        console.print(f"wrote {path}", highlight=False, soft_wrap=True)


def _write_trajectories(run: Path, file: Path) -> None:
    try:
        from studies.trajectories import write_trajectories
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"--trajectories needs {error.name} (extra `study`): {to_install('study')}"
        ) from None
    number = write_trajectories(run, file)
    console.print(f"wrote {number} tracks to {file}", highlight=False, soft_wrap=True)


@app.command("draw")
def draw_command(
    run: RecordedRun = None,
    *,
    png: Annotated[Path | None, typer.Option(help="default RUN/frame-N.png")] = None,
    frame: Annotated[
        int | None, typer.Option(help="a frame with scans; default the fullest")
    ] = None,
) -> None:
    """Draw the merged cloud of a frame with its boxes over the lanes."""
    try:
        from studies.frame_picture import draw_frame
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"drawing needs {error.name} (extra `plot`): {to_install('plot')}"
        ) from None
    run = run or newest_run()
    console.print(f"wrote {draw_frame(run, frame, png)}", highlight=False, soft_wrap=True)


@app.command("scenario")
def scenario_command(
    name: Annotated[str, typer.Argument(help="built-in name or YAML file")] = "t_junction",
    set_: Override = None,
) -> None:
    """Print a scenario with every key and its value, ready to be edited."""
    data = scenarios.load(name, assigned(set_)).model_dump(mode="json")
    typer.echo(yaml.safe_dump(data, sort_keys=False), nl=False)


@cache
def command() -> Callable[[], object]:
    """Returns the tree of commands; to build it takes 0.2 s."""
    return typer.main.get_command(app)


def main() -> None:
    """Runs the command; a user's mistake ends with one clear message and status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    try:
        command()()
    except CpnetError as error:
        errors.print(f"[bold red]error[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(2)
