"""The cells of a study with the user's settings, and studies run by a Python program."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cpnet import scenario as scenarios
from cpnet.main_module import guard_needed
from edge_server.config import EdgeConfig
from perception.registry import check
from protocol.errors import ConfigError, CpnetError
from protocol.extras import to_install
from studies.sweep.cells import Cell, ResultStore, cells_of
from studies.sweep.study_file import Study, StudyFile, read_study, study_of

if TYPE_CHECKING:
    import polars as pl
    from distributed import Client

    from studies.sweep.engine import Failure


def planned(
    file: StudyFile, settings: dict[str, Any], seeds: list[int]
) -> tuple[Study, list[Cell]]:
    """Returns a study with other settings and seeds, and all its cells.

    Raises:
        ConfigError: a setting or a cell is invalid, or a detector cannot be had here.
    """
    study = file.study.changed(settings, seeds)
    try:
        cells = cells_of(study, lambda keys: resolved(file.scenario, keys))
    except ConfigError as error:
        raise ConfigError(f"{file.source}: {error}") from None
    _check_detectors(study, cells)
    return study, cells


def resolved(name: str, settings: dict[str, Any]) -> dict[str, Any]:
    """Returns every key of a scenario with settings laid over it."""
    return scenarios.load(name, settings).model_dump(mode="json")


def _check_detectors(study: Study, cells: list[Cell]) -> None:
    """Checks before the first run that every detector is available.

    Raises:
        ConfigError: a detector of a cell, or of the accuracy part, cannot be had here.
    """
    asked = {json.dumps(cell.scenario["edge"], sort_keys=True) for cell in cells}
    configs = [EdgeConfig.model_validate_json(text) for text in sorted(asked)]
    more = study.accuracy.detectors if study.accuracy else []
    configs += [configs[0].model_copy(update={"detector": name}) for name in more]
    for config in {config.detector: config for config in configs}.values():
        check(config)


def run_study(
    what: str | Path | Mapping[str, Any],
    out: Path | str | None,
    jobs: int,
    seeds: list[int] | None,
    settings: dict[str, Any],
    *,
    keep_runs: bool,
) -> pl.DataFrame:
    """Runs the missing cells of a study and returns its table; see `cpnet.study`."""
    try:
        from studies.sweep.results import table
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"studies need {error.name} (extra `study`): {to_install('study')}"
        ) from None
    if jobs < 1:
        raise ConfigError(f"jobs is {jobs}, must be 1 or more")
    file = study_of(what) if isinstance(what, Mapping) else read_study(str(what))
    _, cells = planned(file, settings, seeds or [])
    if out is None:
        with tempfile.TemporaryDirectory(prefix="cpnet-study-") as folder:
            return table(cells, _run_missing(cells, ResultStore.at(Path(folder)), jobs, False))
    return table(cells, _run_missing(cells, ResultStore.at(Path(out)), jobs, keep_runs))


def _run_missing(cells: list[Cell], store: ResultStore, jobs: int, keep_runs: bool) -> ResultStore:
    """Runs the cells that are not done; returns the store.

    Raises:
        ConfigError: every one of them failed.
    """
    from studies.sweep.engine import missing

    todo = missing(cells, store)
    work = _run_here if jobs == 1 else _run_in_processes
    failures = work(todo, store, jobs, keep_runs)
    if failures and len(failures) == len({cell.id for cell in cells}):
        raise ConfigError(f"no cell was done: {failures[0].reason}")
    return store


def _run_here(todo: list[Cell], store: ResultStore, _: int, keep_runs: bool) -> list[Failure]:
    from studies.sweep.engine import Failure
    from studies.sweep.worker import Task, run_cell

    failures = []
    for cell in todo:
        run_dir = str(store.run_dir(cell.id)) if keep_runs else None
        try:
            store.save(cell, run_cell(Task(cell.scenario, version("cpnet-edge"), run_dir)))
        except CpnetError as error:
            store.record_failure(cell, error)
            failures.append(Failure(cell, str(error)))
    return failures


def _run_in_processes(
    todo: list[Cell], store: ResultStore, jobs: int, keep_runs: bool
) -> list[Failure]:
    from rich.console import Console

    from studies.sweep.engine import Engine, ProgressDisplay

    if not todo:
        return []
    quiet = ProgressDisplay(Console(quiet=True), len(todo), 0)
    with quiet, _workers(min(jobs, len(todo))) as client:
        return Engine(client, store, quiet, keep_runs=keep_runs).run(todo)


@contextmanager
def _workers(jobs: int) -> Iterator[Client]:
    """Starts worker processes here.

    Raises:
        ConfigError: they cannot be started.
    """
    from studies.sweep.cluster import local

    with ExitStack() as stack:
        try:
            client = stack.enter_context(local(jobs))
        except RuntimeError as error:
            why = f"jobs is {jobs}: no process of them could be started ({error}); in a script"
            raise ConfigError(guard_needed(why)) from None
        yield client
