"""`cpnet bench looking`: one run, looked on at for some seconds, then not, again and again."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cpnet.running import FILE_NAME
from cpnet.scenario import load
from cpnet.viewing import needs_extra
from protocol.errors import ConfigError
from recorder.run import Run
from studies.bench_choices import LOOKING_WAYS
from studies.bench_looking import LookingRow, Span, rows_of

_SCENARIO = "t_junction"
_BEGINS_S = 60.0  # until it is up
_ENDS_S = 10.0
_FASTEST = 10.0  # times real time: no run is over before it was looked at
_MOST_S = 86_400.0  # simulated, that a run may last
_LATER_S = 3.0  # in the first frames all is new
_POLL_S = 0.1


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
        for way in self.ways:
            if not set(_parts(way)) <= set(LOOKING_WAYS) or not way:
                known = ", ".join(LOOKING_WAYS)
                raise ConfigError(f"--ways {way!r}: must be of {known}, or some of these with +")
        load(_SCENARIO, self.keys)


def measure_looking(bench: LookingBench) -> list[LookingRow]:
    """Looks on in each way in turn, then ends the run.

    Raises:
        ConfigError: what is asked for cannot be measured, or the run failed.
    """
    bench.check()
    if any(_parts(way) != ["record"] for way in bench.ways):
        with needs_extra():
            import viewer.log  # noqa: F401 - says what to install before a run begins
    with tempfile.TemporaryDirectory(prefix="cpnet-bench-") as name, ExitStack() as stack:
        scratch = Path(name)
        run = stack.enter_context(_running(bench, scratch / "run"))
        _wait_for(run, scratch / "run")
        names = dict.fromkeys(name for way in bench.ways for name in _parts(way))
        lookers = {
            name: stack.enter_context(_Looker(name, scratch / "run", scratch)) for name in names
        }
        time.sleep(_LATER_S)
        turns = [way for _ in range(bench.looks) for way in bench.ways]
        spans = [
            _span([lookers[name] for name in _parts(way)], way, bench.span_s)
            for way in _apart(turns)
        ]
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


def _wait_for(run: subprocess.Popen[bytes], run_dir: Path) -> None:
    give_up_ns = time.monotonic_ns() + round(_BEGINS_S * 1e9)
    while not (run_dir / FILE_NAME).exists():
        if run.poll() is not None or time.monotonic_ns() > give_up_ns:
            said = (run_dir.parent / "said").read_text("utf-8")
            raise ConfigError(f"the run did not begin:\n{said}")
        time.sleep(_POLL_S)


def _apart(turns: list[str]) -> list[str | None]:
    """Returns ways with nobody before, between and after them."""
    return [None, *(one for way in turns for one in (way, None))]


def _span(lookers: Sequence[_Looker], way: str | None, span_s: float) -> Span:
    begin_ns = time.monotonic_ns()
    for looker in lookers:
        looker.begin()
    time.sleep(span_s)
    for looker in lookers:
        looker.end()
    return Span(way, begin_ns, time.monotonic_ns())


def _parts(way: str | None) -> list[str]:
    """Returns what is done at the same time in a way."""
    return way.split("+") if way else []


class _Looker:
    """A process that looks on in one way; see `cpnet.bench_looker`. A context manager."""

    def __init__(self, way: str, run_dir: Path, scratch: Path) -> None:
        command = [sys.executable, "-m", "cpnet.bench_looker", way, str(run_dir), str(scratch)]
        self._way = way
        self._said = (scratch / f"{way}.log").open("w+", encoding="utf-8")
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=self._said, text=True
        )

    def __enter__(self) -> _Looker:
        self._wait()
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(_ENDS_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._said.close()

    def begin(self) -> None:
        """Begins to look on."""
        self._tell()

    def end(self) -> None:
        """Looks on no more.

        Raises:
            ConfigError: the process has ended.
        """
        self._tell()
        self._wait()

    def _tell(self) -> None:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # whoever waits for an answer tells what happened
            print(file=self._process.stdin, flush=True)

    def _wait(self) -> None:
        assert self._process.stdout is not None
        if self._process.stdout.readline():
            return
        self._said.seek(0)
        raise ConfigError(f"looking on in the way {self._way} failed:\n{self._said.read()}")
