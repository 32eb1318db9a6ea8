"""The engine: cells out to Dask workers, figures back, each kept the moment it is there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Protocol

from distributed import Client, wait

from protocol.errors import BusError, CpnetError
from studies.sweep.cell import Cell
from studies.sweep.store import Store
from studies.sweep.work import Outcome, Task, do

POLL_S = 0.5  # how soon a stop is heeded, and how soon workers that came later are noticed
Work = Callable[[Task], Outcome]


@dataclass(frozen=True, slots=True)
class Failure:
    """A cell that has no figures; the next start tries it again."""

    cell: Cell
    reason: str


class Watcher(Protocol):
    """Is told how a study goes on."""

    def started(self, cell: Cell) -> None:
        """A worker was given a cell."""

    def finished(self, cell: Cell) -> None:
        """A cell was done and is kept."""

    def failed(self, failure: Failure) -> None:
        """A cell went wrong."""

    def waits(self, workers: int) -> None:
        """A moment passed without anything; tells how many workers there are."""


def missing(cells: Iterable[Cell], store: Store) -> list[Cell]:
    """Returns those that are still to be run; equal ones once."""
    first: dict[str, Cell] = {}
    for cell in cells:
        first.setdefault(cell.id, cell)
    return [cell for cell in first.values() if store.row(cell.id) is None]


class Engine:
    """Keeps as many cells in flight as there are workers, so that a death hits no other cell."""

    def __init__(
        self,
        client: Client,
        store: Store,
        watcher: Watcher,
        *,
        keep_runs: bool,
        work: Work = do,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self._client = client
        self._store = store
        self._watcher = watcher
        self._keep_runs = keep_runs
        self._work = work
        self._check = check
        self._flying: dict[Any, Cell] = {}

    def run(self, cells: list[Cell]) -> list[Failure]:
        """Runs cells to the last; returns those that failed.

        Raises:
            BusError: the scheduler was lost.
            KeyboardInterrupt: `check` says so.
        """
        todo = cells[::-1]
        failures = []
        while todo or self._flying:
            self._check()
            while todo and len(self._flying) < max(1, self._workers()):
                self._send(todo.pop())
            for future in self._landed():
                failure = self._take(future, self._flying.pop(future))
                failures += [failure] if failure else []
        return failures

    def _workers(self) -> int:
        try:
            return len(self._client.nthreads())
        except (OSError, CancelledError) as error:
            raise _lost() from error

    def _send(self, cell: Cell) -> None:
        keep = str(self._store.run_dir(cell.id)) if self._keep_runs else None
        task = Task(cell.scenario, version("cpnet-edge"), keep)
        future = self._client.submit(self._work, task, key=f"cell-{cell.id}", pure=False)
        self._flying[future] = cell
        self._watcher.started(cell)

    def _landed(self) -> list[Any]:
        try:
            done = wait(list(self._flying), timeout=POLL_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            self._watcher.waits(self._workers())
            return []
        except CancelledError as error:
            raise _lost() from error
        return list(done)

    def _take(self, future: Any, cell: Cell) -> Failure | None:  # noqa: ANN401 - Dask's is untyped
        if future.status == "finished":
            self._store.keep(cell, future.result())
            self._watcher.finished(cell)
            return None
        if future.status != "error":
            raise _lost()
        error = future.exception()
        self._store.blame(cell, error)
        failure = Failure(cell, _reason(error))
        self._watcher.failed(failure)
        return failure


def _reason(error: BaseException) -> str:
    if isinstance(error, CpnetError):
        return str(error)
    if type(error).__name__ == "KilledWorker":
        return "its worker process died again and again, as when memory runs out"
    return f"{type(error).__name__}: {error}"


def _lost() -> BusError:
    return BusError("the scheduler was lost; the same command goes on with what is left")
