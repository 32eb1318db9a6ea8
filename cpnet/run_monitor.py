"""Follows a run to its end: shows progress, reports stalls and failures, gives the exit status."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from cpnet.exit_report import ExitReport
from cpnet.processes import MCAP
from cpnet.scenario import Scenario
from cpnet.supervisor import Supervisor
from cpnet.watch import WorldWatch, all_processes
from protocol.bus import Endpoint
from protocol.errors import BusError
from protocol.messages import Progress

if TYPE_CHECKING:
    from cpnet.metrics_page import RunMetrics  # prometheus_client: only runs with --metrics need it


STALL_NS = 3_000_000_000


class StallCheck:
    """Reports once when no new frame arrives, and again when frames resume.

    A run may be slow: a stall is a gap longer than every gap before it.
    """

    def __init__(self) -> None:
        self._frame: int | None = None
        self._since_ns = 0
        self._longest_ns = STALL_NS
        self._is_stalled = False
        self._stopped: set[str] = set()

    def frames(self, frame: int | None, now_ns: int) -> str | None:
        """Updates by the newest frame received, None before the first."""
        silent_ns = now_ns - self._since_ns
        if frame != self._frame:
            if self._frame is not None:
                self._longest_ns = max(self._longest_ns, silent_ns)
            was_stalled, self._is_stalled = self._is_stalled, False
            self._frame, self._since_ns = frame, now_ns
            return f"frames come again, after {silent_ns / 1e9:.0f} s" if was_stalled else None
        if frame is None or self._is_stalled or silent_ns <= self._longest_ns:
            return None
        self._is_stalled = True
        return f"no frame for {silent_ns / 1e9:.0f} s"

    def stopped(self, processes: Iterable[str]) -> list[str]:
        """Updates by the processes that a signal has stopped for too long."""
        now = set(processes)
        news = [
            f"nothing heard from {name}: it is stopped (SIGSTOP)" for name in now - self._stopped
        ]
        news += [f"{name} goes on" for name in self._stopped - now]
        self._stopped = now
        return sorted(news)


LINE_EVERY_NS = 5_000_000_000
MAX_AGENTS = 12


class Display:
    """Shows each `Progress`; a context manager."""

    def __init__(self, console: Console, scenario: Scenario) -> None:
        self._console = console
        self._scenario = scenario
        self._live = Live(console=console, transient=True, auto_refresh=False)
        self._shown_ns = 0

    def __enter__(self) -> Display:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, progress: Progress) -> None:
        """Draws the newest state of the run, once a frame is complete; times lack the warm-up."""
        if not progress.end_to_end_ms:
            return
        time_s = (progress.frame + 1) * self._scenario.frame_period_s
        if self._console.is_terminal:
            self._live.update(_panel(progress, time_s, self._scenario.duration_s), refresh=True)
        elif time.monotonic_ns() - self._shown_ns >= LINE_EVERY_NS:
            self._shown_ns = time.monotonic_ns()
            line = _line(progress, time_s)
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)


def _line(progress: Progress, time_s: float) -> str:
    total_mbps = sum(progress.mbps.values())
    return (
        f"{time_s:6.1f} s  x{progress.real_time_factor:.2f}  {progress.vehicles} vehicles  "
        f"{progress.cavs} CAVs  {progress.detections} found  {total_mbps:.1f} Mbit/s  "
        f"{progress.end_to_end_ms:.0f} ms  {progress.state}"
    )


def _panel(progress: Progress, time_s: float, duration_s: float) -> RenderableType:
    table = Table.grid(padding=(0, 3))
    table.add_row("frame", f"{progress.frame}", "simulated", f"{time_s:.1f} of {duration_s:g} s")
    table.add_row(
        "real-time factor",
        f"{progress.real_time_factor:.2f}",
        "end to end",
        f"{progress.end_to_end_ms:.0f} ms",
    )
    table.add_row(
        "vehicles",
        f"{progress.vehicles} ({progress.cavs} CAVs, {progress.cvs} CVs)",
        "detected",
        f"{progress.detections}",
    )
    table.add_row("signal", _signal(progress.state), "dropped", f"{progress.drops}")
    agents = Table.grid(padding=(0, 3))
    for name, mbps in sorted(progress.mbps.items())[:MAX_AGENTS]:
        agents.add_row(Text(name, "cyan"), f"{mbps:.2f} Mbit/s")
    bar = Table.grid()
    bar.add_row(ProgressBar(total=duration_s, completed=min(time_s, duration_s), width=60))
    return Group(bar, table, Text("uplink", "bold"), agents)


def _signal(state: str) -> Text:
    colours = {"g": "green", "y": "yellow", "r": "red"}
    text = Text()
    for letter in state:
        text.append("●", colours.get(letter.lower(), "white"))
    return text


POLL_S = 0.05
LATE_END_S = 2.0
OTHERS_LEAVE_S = 12.0  # longer than the timeout of a recorder elsewhere
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopSignals:
    """Turns SIGINT, SIGTERM and SIGHUP into an event for as long as a run lasts."""

    def __init__(self) -> None:
        self.event = threading.Event()
        self.number = 0

    def __enter__(self) -> StopSignals:
        self._before = {n: signal.signal(n, self._take) for n in STOP_SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _take(self, number: int, _: object) -> None:
        self.number = number
        self.event.set()


@dataclass(frozen=True, slots=True, eq=False)
class RunMonitor:
    """Follows a run whose processes were started here, to its end.

    With `restart`, processes that fail here are restarted, and processes of other machines may
    leave and join; else a failure ends the run, wherever it was. That of mcap does not, once the
    run has begun: it is reported at once, and at the end.
    """

    supervisor: Supervisor
    scenario: Scenario
    stop_signals: StopSignals
    console: Console
    restart: bool
    metrics: RunMetrics | None = None

    def follow(self, world: Endpoint) -> int:
        """Returns the exit status."""
        failure, reason = None, ""
        recordings: list[ExitReport] = []
        watch = self._watch(world)
        if isinstance(watch, ExitReport):
            failure = watch
        elif watch is not None:
            with watch, Display(self.console, self.scenario) as display:
                failure = self._follow(watch, display, recordings)
                reason = watch.end.reason if watch.end else ""
        status = self._status(failure, reason)
        for recording in recordings:
            self._report("the recording is not whole: ", recording)
        return status or len(recordings)

    def _status(self, failure: ExitReport | None, reason: str) -> int:
        if self.stop_signals.event.is_set():
            self.console.print(f"stopping ({signal.Signals(self.stop_signals.number).name})")
            return 128 + self.stop_signals.number
        if failure is not None:
            self._report("", failure)
            return 1
        if reason != "finished":
            said = reason or "nobody said why"
            self.console.print(f"the world ended before its time: {said}", markup=False)
            return 1
        return 0

    def _report(self, what: str, failure: ExitReport) -> None:
        name = escape(failure.id)
        self.console.print(f"[bold red]{what}{name} {failure.how}[/]; the last lines of its log:")
        self.console.print(failure.tail, highlight=False, markup=False, soft_wrap=True)

    def _watch(self, world: Endpoint) -> WorldWatch | ExitReport | None:
        """Connects to the world bus as soon as it is up; a process may fail before."""
        while not self.stop_signals.event.is_set():
            if failure := self.supervisor.failure(at_end=False):
                return failure
            try:
                return WorldWatch(world, all_processes(self.scenario), self.metrics)
            except BusError:
                self.stop_signals.event.wait(POLL_S)
        return None

    def _follow(
        self, watch: WorldWatch, display: Display, recordings: list[ExitReport]
    ) -> ExitReport | None:
        ended_ns = 0
        stall_check = StallCheck()
        while not self.stop_signals.event.is_set():
            if watch.update(POLL_S) and watch.progress:
                display.show(watch.progress)
            if watch.end is None:
                self._report_stall(stall_check, watch)
            if failure := self._fatal(watch, recordings):
                return failure
            if watch.end is None and (elsewhere := self._lost_elsewhere(watch)):
                return elsewhere
            if watch.end is not None:
                ended_ns = ended_ns or time.monotonic_ns()
                late = time.monotonic_ns() - ended_ns > OTHERS_LEAVE_S * 1e9
                awaited = self.supervisor.running(MCAP.role) or watch.here("record")
                if not self.supervisor.running("sim", "record") and (late or not awaited):
                    return None
        return None

    def _report_stall(self, stall_check: StallCheck, watch: WorldWatch) -> None:
        has_begun = watch.progress is not None and watch.progress.end_to_end_ms > 0
        frame = watch.progress.frame if watch.progress and has_begun else None
        news = stall_check.stopped(self.supervisor.stopped(STALL_NS))
        for line in (*news, stall_check.frames(frame, time.monotonic_ns())):
            if line is not None:
                self.console.print(line, markup=False, highlight=False)

    def _await_late_end(self, watch: WorldWatch) -> None:
        """Waits a little if a process has left and none failed: its message may be in transit."""
        has_left = self.supervisor.failure(at_end=False) is not None
        if watch.end is None and has_left and self.supervisor.failure(at_end=True) is None:
            watch.await_end(LATE_END_S)

    def _fatal(self, watch: WorldWatch, recordings: list[ExitReport]) -> ExitReport | None:
        """Returns a failure that ends the run; other processes are restarted or are not needed."""
        self._await_late_end(watch)
        at_end = watch.end is not None
        if not at_end and (failure := self.supervisor.fork_server_exit()) is not None:
            if not self.restart:
                return failure
            self.console.print(
                f"{failure.id} {failure.how}; another starts with the next process", markup=False
            )
        if self.restart and not at_end:
            lost = self._restart_ended()
            if any(failure.id == MCAP.role for failure in lost):
                recordings += self._dismiss_recording(at_end=False)
            return next((failure for failure in lost if failure.id != MCAP.role), None)
        if watch.progress is not None:
            recordings += self._dismiss_recording(at_end=at_end)
        failure = self.supervisor.failure(at_end=at_end)
        if failure is not None:
            self._await_late_end(watch)  # it may have left only just now
            failure = self.supervisor.failure(at_end=watch.end is not None)
        is_recording = (
            failure is not None and failure.id == MCAP.role and watch.progress is not None
        )
        return None if is_recording else failure  # that of a recording is removed next time

    def _dismiss_recording(self, *, at_end: bool) -> list[ExitReport]:
        failure = self.supervisor.remove_failed(MCAP.role, at_end=at_end)
        if failure is None:
            return []
        self.console.print(f"{failure.id} {failure.how}; the run goes on without it", markup=False)
        return [failure]

    def _restart_ended(self) -> list[ExitReport]:
        found, lost = self.supervisor.restart_ended()
        for failure in found:
            self.console.print(f"{failure.id} {failure.how}", markup=False)
            if self.metrics is not None:
                self.metrics.restarted(failure.id)
        return lost

    def _lost_elsewhere(self, watch: WorldWatch) -> ExitReport | None:
        """Returns a process of another machine that left before the run's end, if that matters."""
        needed = {"sim"}
        if not self.restart:
            needed.update(process for _, process in all_processes(self.scenario))
            needed.discard(MCAP.role)
        for role, process in watch.lost():
            if process in needed and not self.supervisor.holds(process):
                watch.await_end(LATE_END_S)  # it may still be in transit, or a link was broken
                if watch.end is None and (role, process) in watch.lost():
                    how = "left another machine before the run ended"
                    return ExitReport(process, how, "(no log here)")
        return None
