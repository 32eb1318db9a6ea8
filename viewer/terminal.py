"""Draws a board in a terminal of any width, repeatedly or once."""

from __future__ import annotations

import threading
import time
from contextlib import suppress

from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from protocol.errors import BusError, MessageError
from protocol.observer import Observer
from viewer.board import AgentRow, Board, JunctionRow, LaneRow, RegionRow

MAX_SHOWN_AGENTS = 16
MAX_LANES = 24
MAX_REGIONS = 16
MAX_JUNCTIONS = 32
MAX_SHOWN_ALERTS = 5
_LEAST_NAME = 6


def picture(board: Board, now_ns: int) -> RenderableType:
    """Returns the tables to be shown now, by the monotonic clock."""
    if board.junction is None:
        tables = [_regions(board.regions()), _stages(board), _junctions(board.junctions())]
    else:
        tables = [_agents(board.agents()), _stages(board), _signal(board)]
        tables += [_lanes(board.lanes(side), side) for side in ("upstream", "downstream")]
    shown = [table for table in tables if table.row_count]
    return Group(_head(board), _alerts(board.alerts(now_ns)), Columns(shown, padding=(0, 3)))


def _head(board: Board) -> RenderableType:
    scenario, progress = board.setup.scenario, board.progress
    title = Text.assemble(
        (str(scenario.get("name", "")), "bold"),
        f"  {scenario.get('mode', '')}  frame {max(board.frame, 0)}",
        f"  {board.sim_time_ns / 1e9:.1f} s",
    )
    if board.end is not None:
        title.append(f"  ended: {board.end.reason}", "bold yellow")
    if progress is None:
        return title
    title.append(
        f"\n×{progress.real_time_factor:.2f} real time   {progress.vehicles} vehicles, "
        f"{progress.cavs} CAVs, {progress.cvs} CVs   {progress.detections} detected   "
        f"{sum(progress.mbps.values()):.1f} Mbit/s   {progress.end_to_end_ms:.0f} ms end to end   "
        f"{len(board.present)} processes"
    )
    return title


def _regions(rows: list[RegionRow]) -> Table:
    table = _table("region", "signals", "frames", "incomplete", "agents", "Mbit/s", "ms")
    for row in rows[:MAX_REGIONS]:
        table.add_row(
            _name(row.region, "cyan"),
            f"{row.junctions}",
            f"{row.frames}",
            Text(f"{row.incomplete}", "red" if row.incomplete else ""),
            f"{row.agents}",
            "–" if row.mbps is None else f"{row.mbps:.2f}",
            "–" if row.mean_ms is None else f"{row.mean_ms:.1f}",
        )
    if len(rows) > MAX_REGIONS:
        table.add_row(_name(f"and {len(rows) - MAX_REGIONS} more"), *[""] * 6)
    return table


def _junctions(rows: list[JunctionRow]) -> Table:
    """Returns a row for each junction; of too many, those with the longest queues."""
    table = _table("signal", "region", "", "since", "vehicles", "queued", "covered")
    table.add_column("phase", no_wrap=True, overflow="ellipsis", max_width=24)
    longest = sorted(rows, key=lambda row: -row.queued)[:MAX_JUNCTIONS]
    for row in (row for row in rows if row in longest):
        table.add_row(
            _name(row.tls, "cyan"),
            row.region,
            Text("●" if row.stage else "–", _lamp(row.stage) if row.stage else ""),
            "–" if row.since_s is None else f"{row.since_s:.1f} s",
            f"{row.vehicles}",
            f"{row.queued}",
            "–" if row.covered is None else f"{row.covered:.0%}",
            Text(row.phase),
        )
    if len(rows) > MAX_JUNCTIONS:
        table.add_row(_name(f"and {len(rows) - MAX_JUNCTIONS} with shorter queues"), *[""] * 7)
    return table


def _agents(rows: list[AgentRow]) -> Table:
    table = _table("agent", "points", "Mbit/s", "score")
    for row in rows[:MAX_SHOWN_AGENTS]:
        style = "" if row.trusted else "red"
        table.add_row(
            _name(row.agent, style or "cyan"),
            f"{row.points}",
            f"{row.mbps:.2f}",
            Text(f"{row.score:.2f}", style),
        )
    if len(rows) > MAX_SHOWN_AGENTS:
        rest = rows[MAX_SHOWN_AGENTS:]
        points, mbps = sum(row.points for row in rest), sum(row.mbps for row in rest)
        table.add_row(_name(f"and {len(rest)} more"), f"{points}", f"{mbps:.2f}", "")
    return table


def _stages(board: Board) -> Table:
    table = _table("stage", "ms", "mean")
    for row in board.stages():
        style = "bold" if row.stage == "end to end" else ""
        figures = (f"{row.newest_ms:.1f}", f"{row.mean_ms:.1f}")
        table.add_row(_name(row.stage, style), *(Text(figure, style) for figure in figures))
    return table


def _signal(board: Board) -> Table:
    table = _table("phase", "pressure", "")
    shown = board.signal()
    for row in board.phase_rows():
        lamp = Text("●", _lamp(shown[0].stage) if shown and row.is_shown else "red")
        pressure = "–" if row.pressure is None else f"{row.pressure:.1f}"
        table.add_row(_name(row.phase, "bold" if row.is_shown else ""), pressure, lamp)
    if shown is not None:
        state, since_s = shown
        asked = f"{state.stage.replace('_', ' ')} for {since_s:.1f} s, by {state.source}"
        table.add_row(_name(asked, "dim"), "", "")
    return table


def _lanes(rows: list[LaneRow], side: str) -> Table:
    table = _table(side, "vehicles", "queued", "seen")
    for row in rows[:MAX_LANES]:
        is_blind = row.seen is not None and row.seen == 0
        seen = "–" if row.seen is None else f"{row.seen:.0%}"
        vehicles = f"{row.vehicles}" + (f" ({row.coasted})" if row.coasted else "")
        table.add_row(_name(row.lane, "dim" if is_blind else ""), vehicles, f"{row.queued}", seen)
    return table


def _alerts(alerts: list[str]) -> RenderableType:
    if not alerts:
        return Text("no alerts", "dim")
    lines = alerts[:MAX_SHOWN_ALERTS]
    if len(alerts) > MAX_SHOWN_ALERTS:
        lines.append(f"and {len(alerts) - MAX_SHOWN_ALERTS} more")
    return Panel(Text("\n".join(lines)), title="alerts", title_align="left", border_style="red")


def _lamp(stage: str) -> str:
    return {"green": "green", "yellow": "yellow"}.get(stage, "red")


def _table(first: str, *others: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold", show_edge=False)
    # In a narrow terminal columns that may wrap give way first: that of names, whose text does not.
    table.add_column(_name(first), min_width=_LEAST_NAME, max_width=40)
    for name in others:
        table.add_column(name, justify="right", no_wrap=True, min_width=len(name))
    return table


def _name(text: str, style: str = "") -> Text:
    return Text(text, style, no_wrap=True, overflow="ellipsis")


EVERY_NS = 500_000_000
PATIENCE_NS = 15_000_000_000
ENOUGH_FRAMES = 50
_POLL_S = 0.1


def show(observer: Observer, board: Board, console: Console, stop: threading.Event) -> None:
    """Draws twice a second until the run ends or the user stops it."""
    with Live(console=console, screen=True, auto_refresh=False) as live:
        drawn_ns = 0
        while not (stop.is_set() or board.is_over):
            listen(observer, board)
            if time.monotonic_ns() - drawn_ns >= EVERY_NS:
                drawn_ns = time.monotonic_ns()
                live.update(picture(board, drawn_ns), refresh=True)
    console.print(picture(board, time.monotonic_ns()))


def show_once(observer: Observer, board: Board, console: Console, stop: threading.Event) -> None:
    """Draws once, when all parts have data; a slow run is waited for.

    Raises:
        BusError: no frame began for long.
    """
    begun_ns = newest_ns = time.monotonic_ns()
    frame, frames = board.frame, 0
    while not (board.is_filled or board.is_over or stop.is_set()):
        now_ns = time.monotonic_ns()
        if board.frame != frame:
            frame, frames, newest_ns = board.frame, frames + 1, now_ns
        has_seen_enough = frames >= ENOUGH_FRAMES and now_ns - begun_ns > PATIENCE_NS
        if has_seen_enough or now_ns - newest_ns > PATIENCE_NS:
            break
        listen(observer, board)
    if stop.is_set():
        return
    if board.frame < 0:
        raise BusError(f"the run is there, but nothing happened for {PATIENCE_NS / 1e9:g} s")
    console.print(picture(board, time.monotonic_ns()))


def listen(observer: Observer, board: Board) -> None:
    """Adds the next received items to the board."""
    if (item := observer.next(_POLL_S)) is None:
        return
    with suppress(MessageError):  # a viewer that attaches later receives ends of earlier spans
        board.take(item)
