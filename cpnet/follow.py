"""Attends a run: shows how it goes, notices deaths, and knows when it is over."""

from __future__ import annotations

import signal
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

from cpnet.crowd import everybody
from cpnet.deaths import Death
from cpnet.display import Display
from cpnet.processes import TAPE
from cpnet.scenario import Scenario
from cpnet.stillness import PATIENCE_NS, Stillness
from cpnet.supervisor import Supervisor
from cpnet.watch import Watch
from protocol.bus import Endpoint
from protocol.errors import BusError

if TYPE_CHECKING:
    from cpnet.metrics_page import RunMetrics  # prometheus_client: only runs with --metrics need it

POLL_S = 0.05
OVERTAKEN_S = 2.0
OTHERS_LEAVE_S = 5.0
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interruption:
    """Turns the signals that ask for an end into an event while a run goes on."""

    def __init__(self) -> None:
        self.event = threading.Event()
        self.number = 0

    def __enter__(self) -> Interruption:
        self._before = {n: signal.signal(n, self._take) for n in STOP_SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _take(self, number: int, _: object) -> None:
        self.number = number
        self.event.set()


@dataclass(frozen=True, slots=True, eq=False)
class Attendant:
    """Follows a run whose processes were started here, to its end.

    With `restart`, what dies here is started again, and processes of other machines may come and
    go; else a death ends the run, wherever it was. Only a tape's does not, once the run has begun:
    it is told of at once, and at the end.
    """

    supervisor: Supervisor
    scenario: Scenario
    interruption: Interruption
    console: Console
    restart: bool
    metrics: RunMetrics | None = None

    def attend(self, world: Endpoint) -> int:
        """Returns the exit status."""
        death, reason = None, ""
        tapes: list[Death] = []
        watch = self._watch(world)
        if isinstance(watch, Death):
            death = watch
        elif watch is not None:
            with watch, Display(self.console, self.scenario) as display:
                death = self._follow(watch, display, tapes)
                reason = watch.end.reason if watch.end else ""
        status = self._conclude(death, reason)
        for tape in tapes:
            self._tell("the tape is not whole: ", tape)
        return status or len(tapes)

    def _conclude(self, death: Death | None, reason: str) -> int:
        if self.interruption.event.is_set():
            self.console.print(f"stopping ({signal.Signals(self.interruption.number).name})")
            return 128 + self.interruption.number
        if death is not None:
            self._tell("", death)
            return 1
        if reason != "finished":
            said = reason or "nobody said why"
            self.console.print(f"the world ended before its time: {said}", markup=False)
            return 1
        return 0

    def _tell(self, what: str, death: Death) -> None:
        name = escape(death.id)
        self.console.print(f"[bold red]{what}{name} {death.how}[/]; the last lines of its log:")
        self.console.print(death.tail, highlight=False, markup=False, soft_wrap=True)

    def _watch(self, world: Endpoint) -> Watch | Death | None:
        """Listens to the world as soon as its bus is there; a process may die before."""
        while not self.interruption.event.is_set():
            if death := self.supervisor.death(at_end=False):
                return death
            try:
                return Watch(world, everybody(self.scenario), self.metrics)
            except BusError:
                self.interruption.event.wait(POLL_S)
        return None

    def _follow(self, watch: Watch, display: Display, tapes: list[Death]) -> Death | None:
        ended_ns = 0
        stillness = Stillness()
        while not self.interruption.event.is_set():
            if watch.update(POLL_S) and watch.progress:
                display.show(watch.progress)
            if watch.end is None:
                self._tell_stillness(stillness, watch)
            if death := self._fatal(watch, tapes):
                return death
            if watch.end is None and (elsewhere := self._lost_elsewhere(watch)):
                return elsewhere
            if watch.end is not None:
                ended_ns = ended_ns or time.monotonic_ns()
                late = time.monotonic_ns() - ended_ns > OTHERS_LEAVE_S * 1e9
                awaited = self.supervisor.running(TAPE.role) or watch.here("record")
                if not self.supervisor.running("sim", "record") and (late or not awaited):
                    return None
        return None

    def _tell_stillness(self, stillness: Stillness, watch: Watch) -> None:
        has_begun = watch.progress is not None and watch.progress.end_to_end_ms > 0
        frame = watch.progress.frame if watch.progress and has_begun else None
        news = stillness.stopped(self.supervisor.stopped(PATIENCE_NS))
        for line in (*news, stillness.frames(frame, time.monotonic_ns())):
            if line is not None:
                self.console.print(line, markup=False, highlight=False)

    def _await_overtaken_end(self, watch: Watch) -> None:
        """Waits a little if a process has left and none failed: the end may be on its way."""
        has_left = self.supervisor.death(at_end=False) is not None
        if watch.end is None and has_left and self.supervisor.death(at_end=True) is None:
            watch.await_end(OVERTAKEN_S)

    def _fatal(self, watch: Watch, tapes: list[Death]) -> Death | None:
        """Returns a death that ends the run; others are started again, or are a tape's."""
        self._await_overtaken_end(watch)
        at_end = watch.end is not None
        if not at_end and (death := self.supervisor.bereft()) is not None:
            if not self.restart:
                return death
            self.console.print(
                f"{death.id} {death.how}; another starts with the next process", markup=False
            )
        if self.restart and not at_end:
            lost = self._revive()
            if any(death.id == TAPE.role for death in lost):
                tapes += self._dismiss_tape(at_end=False)
            return next((death for death in lost if death.id != TAPE.role), None)
        if watch.progress is not None:
            tapes += self._dismiss_tape(at_end=at_end)
        if self.supervisor.death(at_end=at_end) is not None:
            self._await_overtaken_end(watch)  # it may have left only just now
        death = self.supervisor.death(at_end=watch.end is not None)
        is_tape = death is not None and death.id == TAPE.role and watch.progress is not None
        return None if is_tape else death  # a tape that died only now is dismissed next time

    def _dismiss_tape(self, *, at_end: bool) -> list[Death]:
        death = self.supervisor.dismiss(TAPE.role, at_end=at_end)
        if death is None:
            return []
        self.console.print(f"{death.id} {death.how}; the run goes on without it", markup=False)
        return [death]

    def _revive(self) -> list[Death]:
        found, lost = self.supervisor.revive()
        for death in found:
            self.console.print(f"{death.id} {death.how}", markup=False)
            if self.metrics is not None:
                self.metrics.restarted(death.id)
        return lost

    def _lost_elsewhere(self, watch: Watch) -> Death | None:
        """Returns a process of another machine that left before the run's end, if that matters."""
        needed = {"sim"}
        if not self.restart:
            needed.update(process for _, process in everybody(self.scenario))
            needed.discard(TAPE.role)
        for who in watch.lost():
            process = who[1]
            if process in needed and not self.supervisor.holds(process):
                watch.await_end(OVERTAKEN_S)  # it may still be on its way, or a link was broken
                if watch.end is None and who in watch.lost():
                    how = "left another machine before the run ended"
                    return Death(process, how, "(no log here)")
        return None
