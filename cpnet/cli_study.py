"""`cpnet study`: many runs from one file, side by side, one table."""

from __future__ import annotations

import json
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cpnet.cli_options import AsJson, Override, assigned, console, errors, junctions_of
from cpnet.compiling import compile_ahead
from cpnet.needs import check_simulator
from cpnet.study_cells import planned, resolved
from protocol.errors import ConfigError
from protocol.extras import to_install
from studies.control_file import ControlStudy, read_control_study
from studies.page.model import Page, Section
from studies.page.write import check_target, save_html, save_markdown
from studies.sweep.cells import Cell, PartKind, ResultStore
from studies.sweep.study_file import Accuracy, Study, path_of, read_study

if TYPE_CHECKING:
    from studies.sweep.engine import Failure

study_app = typer.Typer()
REPORT = "report.html"  # in the folder of results
_SCENARIO = "t_junction"  # whose defaults apply to controls with perception


@study_app.command("study")
def study_command(  # noqa: PLR0913 - one parameter per option of the command
    what: Annotated[str, typer.Argument(help="study file or built-in name")],
    *,
    out: Annotated[Path | None, typer.Option(help="results; default runs/study-NAME")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="of your own Dask cluster")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, max=512, help="processes here; default one a core")
    ] = None,
    seeds: Annotated[
        str | None, typer.Option(metavar="N,...", help="instead of the file's; 1-10 is a range")
    ] = None,
    net: Annotated[Path | None, typer.Option(help="your own .net.xml")] = None,
    tls: Annotated[
        list[str] | None, typer.Option(metavar="ID,...|all", help="the signals of that net")
    ] = None,
    set_: Override = None,
    markdown: Annotated[
        Path | None, typer.Option(help="the report as Markdown too, figures beside it")
    ] = None,
    keep_runs: Annotated[
        bool, typer.Option("--keep-runs", help="keep each run folder, in OUT/runs")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Run every cell of a study that is not done yet; then write table and report."""
    if scheduler is not None and (jobs is not None or keep_runs):
        raise ConfigError(
            "--scheduler: goes with neither --jobs nor --keep-runs: its workers decide"
        )
    found = _control_study(what, assigned(set_), seeds_of(seeds), net)
    if found is not None:
        elsewhere = scheduler is not None or keep_runs or tls is not None
        _run_control(found, out, jobs, markdown, as_json=as_json, elsewhere=elsewhere)
        return
    file = read_study(what)
    own = {
        "traffic.net": net and str(net.resolve()),
        "junctions": junctions_of(tls),
    }
    settings = {key: value for key, value in own.items() if value is not None} | assigned(set_)
    if markdown is not None:
        check_target(markdown, "--markdown")
    check_simulator()
    compile_ahead(errors)
    study, cells = planned(file, settings, seeds_of(seeds))
    with explained_if_missing():
        from studies.sweep.results import parts_table, table, write_table
    store = ResultStore.at(out or Path("runs") / f"study-{study.name}")
    with _stopped_by_signals() as stop:
        failures = _run(cells, store, scheduler, jobs, stop, keep_runs=keep_runs)
    frame = table(cells, store)
    if not len(frame):
        raise ConfigError(f"{what}: no cell was done: {failures[0].reason}")
    path = write_table(frame, store)
    kinds: tuple[PartKind, ...] = ("junctions", "regions")
    parts = [write_table(parts_table(cells, store, one), store, f"{one}.parquet") for one in kinds]
    if study.title is not None and not as_json:
        console.print(study.title, style="bold", markup=False, highlight=False)
    _print_results(frame, cells, failures, [path, *parts], as_json=as_json)
    scenario = resolved(file.scenario, study.settings | {"seed": study.seeds[0]})
    page = _page(study, scenario, frame, cells, store)
    reports = {store.folder / REPORT: save_html}
    if markdown is not None:
        reports[markdown] = save_markdown
    for report, save in reports.items():
        save(page, report)
        if not as_json:
            console.print(f"wrote {report}", highlight=False, soft_wrap=True)
    raise typer.Exit(1 if failures else 0)


def _control_study(
    what: str, changes: dict[str, Any], seeds: list[int], net: Path | None
) -> ControlStudy | None:
    """Returns a study of signal policies on SUMO alone; None if it is of another kind."""
    own: dict[str, Any] = {} if net is None else {"nets": {str(net): [1.0]}}
    return read_control_study(path_of(what), changes | own | ({"seeds": seeds} if seeds else {}))


def _run_control(
    study: ControlStudy,
    out: Path | None,
    jobs: int | None,
    markdown: Path | None,
    *,
    as_json: bool,
    elsewhere: bool,
) -> None:
    """Runs the missing runs of such a study; then prints and writes its tables.

    Raises:
        ConfigError: it is to run `elsewhere` or to keep run folders, which it does not make.
    """
    if elsewhere:
        raise ConfigError(f"study {study.name}: goes with none of --scheduler, --keep-runs, --tls")
    with explained_if_missing():
        from recording.database import versions
        from studies.control_page import control_page, print_control_study
        from studies.control_study import run_control_study, summaries
        from studies.perceived_study import perceived_cases, run_perceived_controls
        from studies.sweep.cluster import usable_cores
    if markdown is not None:
        check_target(markdown, "--markdown")
    folder = out or Path("runs") / f"study-{study.name}"

    def report(done: int, total: int, last: str) -> None:
        if last:
            errors.print(f"{done}/{total}  {last}", markup=False, highlight=False, soft_wrap=True)

    if study.perceived:
        check_simulator()
    cases = perceived_cases(study, folder, lambda keys: resolved(_SCENARIO, keys))
    if cases:
        compile_ahead(errors)
    processes = jobs or len(usable_cores())
    results = run_control_study(study, folder, processes, report)
    results += run_perceived_controls(study, cases, folder, processes, report)
    rows = summaries(study, results)
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        print_control_study(rows, console)
    page = control_page(study, rows, shlex.join(["cpnet", *sys.argv[1:]]), versions())
    save_html(page, folder / REPORT)
    if markdown is not None:
        save_markdown(page, markdown)
    if not as_json:
        console.print(f"wrote {folder / REPORT}", highlight=False, soft_wrap=True)


def _run(
    cells: list[Cell],
    store: ResultStore,
    scheduler: str | None,
    jobs: int | None,
    stop: StopRequest,
    *,
    keep_runs: bool,
) -> list[Failure]:
    """Runs the missing cells; returns those that failed."""
    with explained_if_missing():
        from studies.sweep.cluster import local, remote, usable_cores
        from studies.sweep.engine import Engine, ProgressDisplay, missing
    todo = missing(cells, store)
    if not todo:
        return []
    kept = len({cell.id for cell in cells}) - len(todo)
    seats = min(jobs or len(usable_cores()), len(todo))
    try:
        with (
            ProgressDisplay(errors, len(todo), kept) as display,
            remote(scheduler) if scheduler else local(seats) as client,
        ):
            engine = Engine(client, store, display, keep_runs=keep_runs, check=stop.check)
            with stop.deferred():
                return engine.run(todo)
    except KeyboardInterrupt as interrupt:
        done = kept + len(todo) - len(missing(cells, store))
        errors.print(
            f"stopped: {done} of {kept + len(todo)} cells are done and kept in {store.folder}; "
            "the same command goes on from there",
            highlight=False,
            soft_wrap=True,
        )
        sys.exit(128 + interrupt.args[0])


def _print_results(
    frame: Any,  # noqa: ANN401 - polars may not be installed
    cells: list[Cell],
    failures: list[Failure],
    paths: list[Path],
    *,
    as_json: bool,
) -> None:
    """Prints the overview; `paths` are the tables: of cells, by junction, by region."""
    from studies.sweep.results import overview, print_overview

    axes = list(dict.fromkeys(name for cell in cells for name in cell.labels))
    if as_json:
        failed = [{"cell": one.cell.title, "reason": one.reason} for one in failures]
        rows = overview(frame, axes).to_dicts()
        tables = dict(zip(("results", "junctions", "regions"), map(str, paths), strict=True))
        results = {**tables, "rows": len(frame), "failed": failed, "cells": rows}
        typer.echo(json.dumps(results, indent=2))
        return
    print_overview(frame, axes, console)
    if failures:
        console.print(f"{len(failures)} cells failed; the same command tries them again")
    console.print(f"wrote {', '.join(map(str, paths))}", highlight=False, soft_wrap=True)


def _page(
    study: Study,
    scenario: dict[str, Any],
    frame: Any,  # noqa: ANN401 - polars may not be installed
    cells: list[Cell],
    store: ResultStore,
) -> Page:
    """Returns the report of a study, with the settings of the command line.

    Args:
        study: as it was run.
        scenario: what its cells have in common, with every key.
        frame: the study's table.
        cells: all of it, also those that the table lacks.
        store: their results.

    Raises:
        ConfigError: a detector cannot be had here.
    """
    from recording.database import versions
    from studies.paper_page import paper_page
    from studies.study_networks import network_sections
    from studies.study_page import bandwidth_page, plain_page
    from studies.study_tables import StudyResults
    from studies.value_page import value_page

    pages = {
        "plain": plain_page,
        "paper": paper_page,
        "bandwidth": bandwidth_page,
        "value": value_page,
    }
    command = shlex.join(["cpnet", *sys.argv[1:]])
    missing = tuple(cell.title for cell in cells if store.row(cell.id) is None)
    networks = network_sections(cells, store)
    results = StudyResults(study, frame, command, versions(), scenario, missing, networks)
    return pages[study.page](results, _accuracy_sections(study.accuracy, scenario, store.folder))


def _accuracy_sections(
    spec: Accuracy | None, scenario: dict[str, Any], folder: Path
) -> tuple[Section, ...]:
    if spec is None:
        return ()
    from studies.accuracy import accuracy_of, accuracy_section
    from studies.accuracy_pictures import scenes_section

    rows = accuracy_of(scenario, spec.detectors, spec.samples, folder)
    return accuracy_section(rows), scenes_section(scenario, spec.detectors[-1])


def seeds_of(text: str | None) -> list[int]:
    """Reads `1,2,5-8`.

    Raises:
        ConfigError: it is not that.
    """
    seeds: list[int] = []
    for part in text.split(",") if text is not None else []:
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise ConfigError(f"--seeds {text}: must be numbers such as 1,2,5-8")
        until = int(last) if dash else int(first)
        if not int(first) <= until < int(first) + 10_000:
            raise ConfigError(f"--seeds {text}: {part} must be a range of 1 to 10000 seeds")
        seeds += range(int(first), until + 1)
    return seeds


@contextmanager
def explained_if_missing() -> Iterator[None]:
    """Raises with install instructions where a library of studies is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"studies need {error.name} (extra `study`): {to_install('study')}"
        ) from None


class StopRequest:
    """A stop by signal: at once, or as soon as `check` is called."""

    def __init__(self) -> None:
        self._is_deferred = False
        self._number: int | None = None

    def take(self, number: int, _: FrameType | None) -> None:
        """Takes the first signal and ignores later ones; workers are ended at once anyway."""
        for which in _STOP_SIGNALS:
            signal.signal(which, signal.SIG_IGN)
        self._number = number
        if not self._is_deferred:
            self.check()

    def check(self) -> None:
        """Raises KeyboardInterrupt with the signal's number, if there was one."""
        if self._number is not None:
            raise KeyboardInterrupt(self._number)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Defers to `check`: an interrupted import leaves broken modules."""
        self._is_deferred = True
        try:
            yield
        finally:
            self._is_deferred = False


_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def _stopped_by_signals() -> Iterator[StopRequest]:
    """Handles SIGTERM like Ctrl-C, once, also where a shell has them ignored."""
    stop = StopRequest()
    before = {which: signal.signal(which, stop.take) for which in _STOP_SIGNALS}
    try:
        yield stop
    finally:
        for which, handler in before.items():
            signal.signal(which, handler)
