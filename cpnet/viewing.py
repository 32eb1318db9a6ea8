"""Attaches viewers to a run."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from cpnet.discovery import RunLocation, find_run
from cpnet.exit_report import describe_status
from cpnet.looking import looking_for
from cpnet.run_monitor import StopSignals
from protocol.errors import ConfigError, CpnetError
from protocol.messages import Setup
from protocol.onlooker import Onlooker, lower_priority
from viewer import board, live, terminal
from viewer.live import Live, modest_inbox
from viewer.scene import Scene

CONNECT_MS = 20_000  # a run that has just been started
SETUP_S = 30.0


@dataclass(frozen=True, slots=True)
class Screen:
    """Where to: a page at a port, a file, or else a window; so many frames a second at most."""

    port: int | None
    save: Path | None
    fps: float


def view(
    run: Path | None, connect: list[str], keys: Path | None, screen: Screen, console: Console
) -> None:
    """Shows a run in Rerun until it ends or is told to stop.

    Raises:
        ConfigError: there is no such run, the extra is missing, or the screen cannot be.
        BusError: the run does not answer.
        ProtocolError: what the run says of itself cannot be read.
        CpnetError: the page's server ended, or the file is not whole.
    """
    lower_priority()
    with needs_extra():
        from viewer.rerun_log import Log
        from viewer.sinks import check, opened
    check(screen.port, screen.save)
    found = find_run(run, connect, keys)
    with _attached(found, live.TOPICS, console) as (onlooker, setup, interruption):
        scene = Scene(setup)
        with opened(screen.port, screen.save, scene) as sink:
            console.print(sink.where, markup=False, highlight=False, soft_wrap=True)
            log = Log(sink.recording, scene)
            following = Live(onlooker.inbox, scene, log, screen.fps)
            if sink.server is not None:
                _stop_without(sink.server, interruption.event)
            following.follow(interruption.event)
            drawn, left_out = following.drawn, following.left_out
            console.print(f"{drawn} frames shown, {left_out} left out to keep up", highlight=False)
            if sink.stays and not interruption.event.is_set():
                console.print("the run has ended; Ctrl-C takes the page away")
                interruption.event.wait()
            if sink.server is not None and (status := sink.server.poll()) is not None:
                if sink.stays:
                    raise CpnetError("Rerun, which served the page, has ended; view the run again")
                if status:  # else somebody closed the window
                    raise CpnetError(
                        f"Rerun's window {describe_status(status)}; --web shows a page"
                    )


def top(
    run: Path | None, connect: list[str], keys: Path | None, console: Console, *, once: bool
) -> None:
    """Shows a run in the terminal until it ends or is told to stop.

    Raises:
        ConfigError: there is no such run.
        BusError: the run does not answer.
    """
    lower_priority()
    found = find_run(run, connect, keys)
    with _attached(found, board.BOARD_TOPICS, console) as (onlooker, setup, interruption):
        filled = board.Board(setup)
        if once:
            terminal.show_once(onlooker, filled, console, interruption.event)
        else:
            terminal.show(onlooker, filled, console, interruption.event)


@contextmanager
def _attached(
    run: RunLocation, topics: Iterable[str], console: Console
) -> Iterator[tuple[Onlooker, Setup, StopSignals]]:
    """Until it is attached a signal ends the command as any other; there is nothing to close."""
    with ExitStack() as stack:
        with looking_for(run, console):
            onlooker = stack.enter_context(
                Onlooker(
                    run.v2x,
                    run.world,
                    topics,
                    inbox=modest_inbox(),
                    timeout_ms=CONNECT_MS,
                    yields=True,
                )
            )
            setup = onlooker.setup(SETUP_S)
        yield onlooker, setup, stack.enter_context(StopSignals())


def _stop_without(server: subprocess.Popen[bytes], stop: threading.Event) -> None:
    """Stops when nobody is left who could show anything: a window was closed, a server died."""

    def wait() -> None:
        server.wait()
        stop.set()

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def needs_extra() -> Iterator[None]:
    """Names the extra where a package is missing that viewing needs."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"viewing needs {error.name} (extra `view`): "
            f"{sys.executable} -m pip install 'cpnet-edge[view]'"
        ) from None
