"""Live progress in the terminal: a table that is redrawn, or a line now and then in a log."""

from __future__ import annotations

import time

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from cpnet.scenario import Scenario
from protocol.messages import Progress

LINE_EVERY_NS = 5_000_000_000
MAX_AGENTS = 12


class Display:
    """Shows each `Progress`; a context manager."""

    def __init__(self, console: Console, scenario: Scenario) -> None:
        self._console = console
        self._scenario = scenario
        self._live = Live(console=console, transient=True, auto_refresh=False)
        self._told_ns = 0

    def __enter__(self) -> Display:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, progress: Progress) -> None:
        """Draws the newest state of the run, once a frame is whole; times leave out the warm-up."""
        if not progress.end_to_end_ms:
            return
        time_s = (progress.frame + 1) * self._scenario.frame_period_s
        if self._console.is_terminal:
            self._live.update(_panel(progress, time_s, self._scenario.duration_s), refresh=True)
        elif time.monotonic_ns() - self._told_ns >= LINE_EVERY_NS:
            self._told_ns = time.monotonic_ns()
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
