"""Draws a board again and again, or once."""

from __future__ import annotations

import threading
import time
from contextlib import suppress

from rich.console import Console
from rich.live import Live

from protocol.errors import BusError, MessageError
from protocol.onlooker import Onlooker
from viewer.top.board import Board
from viewer.top.screen import picture

EVERY_NS = 500_000_000
PATIENCE_NS = 15_000_000_000
_POLL_S = 0.1


def show(onlooker: Onlooker, board: Board, console: Console, stop: threading.Event) -> None:
    """Draws twice a second until the run ends or somebody stops it."""
    with Live(console=console, screen=True, auto_refresh=False) as live:
        drawn_ns = 0
        while not (stop.is_set() or board.is_over):
            listen(onlooker, board)
            if time.monotonic_ns() - drawn_ns >= EVERY_NS:
                drawn_ns = time.monotonic_ns()
                live.update(picture(board, drawn_ns), refresh=True)
    console.print(picture(board, time.monotonic_ns()))


def show_once(onlooker: Onlooker, board: Board, console: Console, stop: threading.Event) -> None:
    """Draws once there is something of all kinds to be shown.

    Raises:
        BusError: nothing was said for long.
    """
    give_up_ns = time.monotonic_ns() + PATIENCE_NS
    while not (board.is_filled or board.is_over or stop.is_set()):
        if time.monotonic_ns() > give_up_ns:
            break
        listen(onlooker, board)
    if stop.is_set():
        return
    if board.frame < 0:
        raise BusError(f"the run is there, but nothing happened for {PATIENCE_NS / 1e9:g} s")
    console.print(picture(board, time.monotonic_ns()))


def listen(onlooker: Onlooker, board: Board) -> None:
    """Takes what comes next."""
    if (item := onlooker.next(_POLL_S)) is None:
        return
    with suppress(MessageError):  # whoever comes into a run hears ends of what had begun before
        board.take(item)
