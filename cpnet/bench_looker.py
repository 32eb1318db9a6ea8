"""A process of `cpnet bench looking`: looks on at a run in one way, again and again.

    python -m cpnet.bench_looker WAY RUN SCRATCH

Each second line of its standard input begins a look, the others end one. It says `ready` when it
can begin, when it looks on, and after each look.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from cpnet.discovery import RunLocation, find_run
from cpnet.looking import FPS
from cpnet.recording_command import keep
from cpnet.viewing import CONNECT_MS, budget
from protocol.courtesy import step_back
from protocol.messages import Setup
from protocol.onlooker import Onlooker
from recording.mcap.recorder import McapRecorder, RecordedContent
from viewer import live
from viewer.scene import Scene

_Look = Callable[[threading.Event], None]


def main() -> None:
    """Looks on until the standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the bench's, which ends this process
    way, run_dir, scratch = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    if way != "record":
        step_back()  # record_run does so once Zenoh's threads run
    found = find_run(run_dir, [], None)
    setup = _setup(found)
    step_back()
    with (_tape if way == "record" else _view)(found, setup, scratch, way) as look:
        _tell_ready()
        while sys.stdin.readline():
            stop = threading.Event()
            waiting = threading.Thread(target=_stop_at_next_line, args=(stop,), daemon=True)
            waiting.start()
            look(stop)
            waiting.join()
            _tell_ready()


def _stop_at_next_line(stop: threading.Event) -> None:
    sys.stdin.readline()
    stop.set()


def _tell_ready() -> None:
    sys.stdout.write("ready\n")
    sys.stdout.flush()


def _setup(found: RunLocation) -> Setup:
    with Onlooker(found.v2x, found.world, (), timeout_ms=CONNECT_MS) as onlooker:
        return onlooker.setup()


@contextmanager
def _tape(found: RunLocation, setup: Setup, scratch: Path, way: str) -> Iterator[_Look]:
    path = scratch / f"{way}.mcap"

    def look(stop: threading.Event) -> None:
        choice = RecordedContent()
        with Onlooker(found.v2x, found.world, choice.topics) as onlooker:
            _tell_ready()
            keep(McapRecorder(setup, lambda: path, onlooker.inbox, choice, stop), onlooker, stop)
        path.unlink()

    yield look


@contextmanager
def _view(found: RunLocation, setup: Setup, scratch: Path, way: str) -> Iterator[_Look]:
    from viewer.log import Log
    from viewer.sinks import free_port, opened

    scene = Scene(setup)
    port, save = (free_port(), None) if way == "web" else (None, scratch / "look.rrd")
    with opened(port, save, scene) as sink:
        log = Log(sink.recording, scene)

        def look(stop: threading.Event) -> None:
            inbox = live.modest_inbox()
            with Onlooker(found.v2x, found.world, live.TOPICS, inbox=inbox, yields=True):
                _tell_ready()
                live.Live(inbox, scene, log, FPS, budget()).follow(stop)

        yield look


if __name__ == "__main__":
    main()
