"""`cpnet bench looking`: one run, looked on at for some seconds, then not, again and again."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cpnet.looking import FPS
from cpnet.running import FILE_NAME, Running, find
from cpnet.scenario import load
from cpnet.taping import keep
from cpnet.viewing import CONNECT_MS, budget, needs_extra
from protocol.courtesy import step_back
from protocol.errors import ConfigError
from protocol.messages import Setup
from protocol.onlooker import Onlooker
from recorder.run import Run
from studies.bench_choices import LOOKING_WAYS
from studies.bench_looking import LookingRow, Span, rows_of
from tape.taping import Choice, Taping
from viewer import live
from viewer.scene import Scene

_SCENARIO = "t_junction"
_BEGINS_S = 60.0  # until it is up
_FASTEST = 10.0  # times real time: no run is over before it was looked at
_MOST_S = 86_400.0  # simulated, that a run may last
_LATER_S = 3.0  # in the first frames all is new
_POLL_S = 0.1
_Look = Callable[[threading.Event], None]


@dataclass(frozen=True, slots=True)
class LookingBench:
    """A lockstep run, looked at so often in each way, for so many real seconds each time."""

    ways: tuple[str, ...] = LOOKING_WAYS
    looks: int = 10
    span_s: float = 4.0
    keys: dict[str, Any] = field(default_factory=dict)

    @property
    def duration_s(self) -> float:
        """For how much simulated time the run has to last."""
        spans = 2 * self.looks * len(self.ways) + 1
        return min(_MOST_S, _FASTEST * (spans * self.span_s + _BEGINS_S))

    def check(self) -> None:
        """Raises ConfigError if it cannot be measured."""
        if unknown := sorted(set(self.ways) - set(LOOKING_WAYS)):
            raise ConfigError(f"--ways {unknown[0]!r}: must be of {', '.join(LOOKING_WAYS)}")
        load(_SCENARIO, self.keys)


def measure_looking(bench: LookingBench) -> list[LookingRow]:
    """Looks on in each way in turn, then ends the run.

    Raises:
        ConfigError: what is asked for cannot be measured, or the run failed.
    """
    bench.check()
    if set(bench.ways) - {"record"}:
        with needs_extra():
            import viewer.log  # noqa: F401 - says what to install before a run begins
    with tempfile.TemporaryDirectory(prefix="cpnet-bench-") as name, ExitStack() as stack:
        scratch = Path(name)
        run = stack.enter_context(_running(bench, scratch / "run"))
        found = _found(run, scratch / "run")
        setup = _setup(found)
        step_back()  # but for Zenoh's threads, which are there now, as in `cpnet record`
        looks = _looks(found, setup, bench.ways, scratch, stack)
        time.sleep(_LATER_S)
        turns = [way for _ in range(bench.looks) for way in looks]
        spans = [_span(looks[way] if way else None, way, bench.span_s) for way in _apart(turns)]
        if run.poll() is not None:
            raise ConfigError(f"the run ended early:\n{(scratch / 'said').read_text('utf-8')}")
        run.send_signal(signal.SIGINT)
        run.wait()
        with Run(scratch / "run") as done:
            ticks = done.query("SELECT tick_ns FROM frames WHERE tick_ns IS NOT NULL")
    return [*rows_of(np.array(ticks, np.int64).ravel(), spans)]


@contextmanager
def _running(bench: LookingBench, run_dir: Path) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "cpnet", "up", _SCENARIO, "--out", str(run_dir)]
    command += ["--mode", "lockstep", "--duration", f"{bench.duration_s:g}"]
    for key, value in bench.keys.items():
        command += ["--set", f"{key}={value}"]
    with (run_dir.parent / "said").open("wb") as said:
        run = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
    try:
        yield run
    finally:
        run.terminate()
        run.wait()


def _found(run: subprocess.Popen[bytes], run_dir: Path) -> Running:
    give_up_ns = time.monotonic_ns() + round(_BEGINS_S * 1e9)
    while not (run_dir / FILE_NAME).exists():
        if run.poll() is not None or time.monotonic_ns() > give_up_ns:
            said = (run_dir.parent / "said").read_text("utf-8")
            raise ConfigError(f"the run did not begin:\n{said}")
        time.sleep(_POLL_S)
    return find(run_dir, [], None)


def _apart(turns: list[str]) -> list[str | None]:
    """Returns ways with nobody before, between and after them."""
    return [None, *(one for way in turns for one in (way, None))]


def _span(look: _Look | None, way: str | None, span_s: float) -> Span:
    stop, begin_ns = threading.Event(), time.monotonic_ns()
    timer = threading.Timer(span_s, stop.set)
    timer.start()
    if look is None:
        stop.wait()
    else:
        look(stop)
    timer.cancel()
    return Span(way, begin_ns, time.monotonic_ns())


def _setup(found: Running) -> Setup:
    with Onlooker(found.v2x, found.world, (), timeout_ms=CONNECT_MS) as onlooker:
        return onlooker.setup()


def _looks(
    found: Running, setup: Setup, ways: tuple[str, ...], scratch: Path, stack: ExitStack
) -> dict[str, _Look]:
    """Returns what looks on in each way; what is made once only is made here."""
    return {
        way: _tape(found, setup, scratch)
        if way == "record"
        else stack.enter_context(_view(found, setup, scratch, way))
        for way in ways
    }


def _tape(found: Running, setup: Setup, scratch: Path) -> _Look:
    path = scratch / "look.mcap"

    def look(stop: threading.Event) -> None:
        choice = Choice()
        with Onlooker(found.v2x, found.world, choice.topics) as onlooker:
            keep(Taping(setup, lambda: path, onlooker.inbox, choice, stop), onlooker, stop)
        path.unlink()

    return look


@contextmanager
def _view(found: Running, setup: Setup, scratch: Path, way: str) -> Iterator[_Look]:
    from viewer.log import Log
    from viewer.sinks import free_port, opened

    scene = Scene(setup)
    port, save = (free_port(), None) if way == "web" else (None, scratch / "look.rrd")
    with opened(port, save, scene) as sink:
        log = Log(sink.recording, scene)

        def look(stop: threading.Event) -> None:
            inbox = live.modest_inbox()
            with Onlooker(found.v2x, found.world, live.TOPICS, inbox=inbox, yields=True):
                live.Live(inbox, scene, log, FPS, budget()).follow(stop)

        yield look
