"""How a study goes on, shown to people: a bar on a terminal, a line for each cell elsewhere."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column

from studies.sweep.cell import Cell
from studies.sweep.engine import Failure

SHOWN = 2  # running cells that are named


class Pace:
    """Tells the time left by what was done so far: cells differ, so it is a guess."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.done = 0
        self._begun_ns = self._last_ns = time.monotonic_ns()

    def step(self) -> None:
        """Counts a cell."""
        self.done += 1
        self._last_ns = time.monotonic_ns()

    def left(self) -> str:
        """Returns the time left as text; nothing is known before the first cell is done."""
        if not self.done:
            return ""
        each_s = (self._last_ns - self._begun_ns) / 1e9 / self.done
        since_s = (time.monotonic_ns() - self._last_ns) / 1e9
        return f"{duration(max(0.0, each_s * (self.total - self.done) - since_s))} left"


def duration(seconds: float) -> str:
    """Returns a time as people say it."""
    minutes, rest_s = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest_s:02d} s" if minutes else f"{rest_s} s"


class Display:
    """A watcher that prints."""

    def __init__(self, console: Console, todo: int, kept: int) -> None:
        self._console = console
        self._pace = Pace(todo)
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
        """Shows what runs."""
        self._running[cell.id] = cell
        self._refresh()

    def finished(self, cell: Cell) -> None:
        """Moves the bar on."""
        self._end(cell)
        if not self._console.is_terminal:
            done = self._kept + self._pace.done
            self._say(f"{done}/{self._kept + self._pace.total}  {cell.title}  {self._pace.left()}")

    def failed(self, failure: Failure) -> None:
        """Says at once what went wrong: a study may take hours."""
        self._end(failure.cell)
        self._say(f"failed  {failure.cell.title}: {failure.reason}")

    def waits(self, workers: int) -> None:
        """Keeps the time left up to date; says so once if nobody is there to work."""
        self._refresh()
        if not workers and not self._is_alone:
            self._say("no worker is connected; the study goes on once one is")
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

    def _say(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)
