"""Runs the cells of a study on Dask workers, keeps each result at once, and shows progress."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError
from dataclasses import dataclass
from importlib.metadata import version
from types import TracebackType
from typing import Any, Protocol, Self

from distributed import Client, wait
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column

from protocol.errors import BusError, CpnetError
from studies.sweep.cells import Cell, ResultStore
from studies.sweep.worker import Outcome, Task, run_cell

POLL_S = 0.5  # delay until a stop or a new worker is noticed
Work = Callable[[Task], Outcome]


@dataclass(frozen=True, slots=True)
class Failure:
    """A cell that has no figures; the next start tries it again."""

    cell: Cell
    reason: str


class ProgressListener(Protocol):
    """Receives the progress of a study."""

    def started(self, cell: Cell) -> None:
        """A worker was given a cell."""

    def finished(self, cell: Cell) -> None:
        """A cell is done and its result saved."""

    def failed(self, failure: Failure) -> None:
        """A cell failed."""

    def idle(self, workers: int) -> None:
        """Nothing happened for `POLL_S`; receives the number of workers."""


def missing(cells: Iterable[Cell], store: ResultStore) -> list[Cell]:
    """Returns the cells that are still to be run; equal ones once."""
    first: dict[str, Cell] = {}
    for cell in cells:
        first.setdefault(cell.id, cell)
    return [cell for cell in first.values() if store.row(cell.id) is None]


class Engine:
    """Keeps as many cells in flight as there are workers: a worker's end costs one cell only."""

    def __init__(
        self,
        client: Client,
        store: ResultStore,
        listener: ProgressListener,
        *,
        keep_runs: bool,
        work: Work = run_cell,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self._client = client
        self._store = store
        self._listener = listener
        self._keep_runs = keep_runs
        self._work = work
        self._check = check
        self._in_flight: dict[Any, Cell] = {}

    def run(self, cells: list[Cell]) -> list[Failure]:
        """Runs cells to the last; returns those that failed.

        Raises:
            BusError: the scheduler was lost.
            KeyboardInterrupt: raised by `check`.
        """
        todo = cells[::-1]
        failures = []
        while todo or self._in_flight:
            self._check()
            while todo and len(self._in_flight) < max(1, self._workers()):
                self._send(todo.pop())
            for future in self._completed():
                failure = self._store_result(future, self._in_flight.pop(future))
                failures += [failure] if failure else []
        return failures

    def _workers(self) -> int:
        try:
            return len(self._client.nthreads())
        except (OSError, CancelledError) as error:
            raise _lost() from error

    def _send(self, cell: Cell) -> None:
        run_dir = str(self._store.run_dir(cell.id)) if self._keep_runs else None
        task = Task(cell.scenario, version("cpnet-edge"), run_dir)
        future = self._client.submit(self._work, task, key=f"cell-{cell.id}", pure=False)
        self._in_flight[future] = cell
        self._listener.started(cell)

    def _completed(self) -> list[Any]:
        try:
            done = wait(list(self._in_flight), timeout=POLL_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            self._listener.idle(self._workers())
            return []
        except CancelledError as error:
            raise _lost() from error
        return list(done)

    def _store_result(self, future: Any, cell: Cell) -> Failure | None:  # noqa: ANN401 - Dask's is untyped
        if future.status == "finished":
            self._store.save(cell, future.result())
            self._listener.finished(cell)
            return None
        if future.status != "error":
            raise _lost()
        error = future.exception()
        self._store.record_failure(cell, error)
        failure = Failure(cell, _reason(error))
        self._listener.failed(failure)
        return failure


def _reason(error: BaseException) -> str:
    if isinstance(error, CpnetError):
        return str(error)
    if type(error).__name__ == "KilledWorker":
        return "its worker process was killed again and again, as when memory runs out"
    return f"{type(error).__name__}: {error}"


def _lost() -> BusError:
    return BusError("the scheduler was lost; the same command goes on with what is left")


SHOWN = 2  # running cells that are named


class TimeLeft:
    """An estimate of the time left, from the cells done so far."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.done = 0
        self._begun_ns = self._last_ns = time.monotonic_ns()

    def step(self) -> None:
        """Counts a cell."""
        self.done += 1
        self._last_ns = time.monotonic_ns()

    def left(self) -> str:
        """Returns the time left as text; empty before the first cell is done."""
        if not self.done:
            return ""
        each_s = (self._last_ns - self._begun_ns) / 1e9 / self.done
        since_s = (time.monotonic_ns() - self._last_ns) / 1e9
        return f"{duration(max(0.0, each_s * (self.total - self.done) - since_s))} left"


def duration(seconds: float) -> str:
    """Returns a duration as text."""
    minutes, rest_s = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest_s:02d} s" if minutes else f"{rest_s} s"


class ProgressDisplay:
    """Prints the progress of a study: a bar on a terminal, a line for each cell elsewhere."""

    def __init__(self, console: Console, todo: int, kept: int) -> None:
        self._console = console
        self._pace = TimeLeft(todo)
        self._kept = kept
        self._running: dict[str, Cell] = {}
        self._is_alone = False
        self._bar = Progress(
            BarColumn(bar_width=12, table_column=Column(min_width=12)),
            MofNCompleteColumn(table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[left]}", table_column=Column(no_wrap=True)),
            TextColumn(
                "{task.description}",
                markup=False,
                table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis"),
            ),
            console=console,
            transient=True,
            expand=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("starting", total=todo + kept, completed=kept, left="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def started(self, cell: Cell) -> None:
        """Shows the cells that run."""
        self._running[cell.id] = cell
        self._refresh()

    def finished(self, cell: Cell) -> None:
        """Advances the bar."""
        self._end(cell)
        if not self._console.is_terminal:
            done = self._kept + self._pace.done
            self._print(
                f"{done}/{self._kept + self._pace.total}  {cell.title}  {self._pace.left()}"
            )

    def failed(self, failure: Failure) -> None:
        """Prints the reason at once: a study may take hours."""
        self._end(failure.cell)
        self._print(f"failed  {failure.cell.title}: {failure.reason}")

    def idle(self, workers: int) -> None:
        """Keeps the time left up to date; prints once if there is no worker."""
        self._refresh()
        if not workers and not self._is_alone:
            self._print("no worker is connected; the study goes on once one is")
        self._is_alone = not workers

    def _end(self, cell: Cell) -> None:
        self._running.pop(cell.id, None)
        self._pace.step()
        self._refresh()

    def _refresh(self) -> None:
        named = [cell.title for cell in self._running.values()]
        more = f" and {len(named) - SHOWN} more" if len(named) > SHOWN else ""
        self._bar.update(
            self._task,
            completed=self._kept + self._pace.done,
            description="; ".join(named[:SHOWN]) + more,
            left=self._pace.left(),
        )

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)
