"""`cpnet bench looking`: a run made twice, each stretch of it looked on at in one of the two."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cpnet.discovery import FILE_NAME, find_run
from cpnet.scenario import Scenario, load
from cpnet.viewing import needs_extra
from perception.arrays import Ints
from protocol.errors import ConfigError
from protocol.inbox import Envelope
from protocol.messages import Tick
from protocol.onlooker import Onlooker
from recording.run import Run
from studies.bench import LOOKING_WAYS
from studies.bench_looking import LookingRow, WatchedRun, row_of

_SCENARIO = "t_junction"
_BEGINS_S = 60.0  # until it is up
_ENDS_S = 10.0
_BEFORE = 4  # stretches of which nothing is asked: who looks on has to load its modules
_POLL_S = 0.1


@dataclass(frozen=True, slots=True)
class LookingBench:
    """Lockstep runs, two in each way, with so many pairs of stretches of so many frames."""

    ways: tuple[str, ...] = LOOKING_WAYS
    pairs: int = 8
    frames: int = 100
    keys: dict[str, Any] = field(default_factory=dict)

    def check(self) -> Scenario:
        """Returns what is run.

        Raises:
            ConfigError: it cannot be measured.
        """
        for way in self.ways:
            if not set(_parts(way)) <= set(LOOKING_WAYS) or not way:
                known = ", ".join(LOOKING_WAYS)
                raise ConfigError(f"--ways {way!r}: must be of {known}, or some of these with +")
        return load(_SCENARIO, self.keys)


def measure_looking(bench: LookingBench) -> Iterator[LookingRow]:
    """Yields a row for each way of looking on, when it is measured.

    Raises:
        ConfigError: what is asked for cannot be measured, or a run failed.
    """
    period_s = bench.check().frame_period_s
    duration_s = ((_BEFORE + 2 * bench.pairs) * bench.frames + 1) * period_s
    if any(_parts(way) != ["record"] for way in bench.ways):
        with needs_extra():
            import viewer.log  # noqa: F401 - says what to install before a run begins
    for way in bench.ways:
        first, second = (_watched(bench, way, turn, duration_s) for turn in (0, 1))
        yield row_of(way, [(first, second)], bench.frames)


def _watched(bench: LookingBench, way: str, turn: int, duration_s: float) -> WatchedRun:
    """Makes a run; every other stretch is looked on at, from the first or from the second on."""
    with tempfile.TemporaryDirectory(prefix="cpnet-bench-") as name, ExitStack() as stack:
        scratch = Path(name)
        run_dir = scratch / "run"
        run = stack.enter_context(_running(bench.keys, duration_s, run_dir))
        _wait_for(run, run_dir)
        lookers = [stack.enter_context(_Looker(one, run_dir, scratch)) for one in _parts(way)]
        looked: set[int] = set()
        for stretch in _stretches(run, run_dir, bench.frames):
            looks = stretch % 2 == turn
            looked |= {stretch} if looks else set()
            for looker in lookers:
                looker.look(looks)
        if run.wait():
            raise ConfigError(f"the run failed:\n{_said(run_dir)}")
        return WatchedRun(_ticks_ns(run_dir), frozenset(looked))


def _stretches(run: subprocess.Popen[bytes], run_dir: Path, frames: int) -> Iterator[int]:
    """Yields the number of each stretch of frames when it begins, but for what had begun before."""
    found, newest = find_run(run_dir, [], None), None
    with Onlooker(found.v2x, found.world, ["tick"]) as onlooker:
        while run.poll() is None:
            item = onlooker.next()
            if not (isinstance(item, Envelope) and isinstance(item.message, Tick)):
                continue
            number = item.message.frame // frames
            if newest is not None and number > newest:
                yield number
            newest = number


def _ticks_ns(run_dir: Path) -> Ints:
    """Returns when each frame began, from the first on, up to one of which nobody knows that."""
    with Run(run_dir) as done:
        rows = done.query("SELECT frame, tick_ns FROM frames WHERE tick_ns NOT NULL ORDER BY frame")
    frames, ticks_ns = np.array(rows, np.int64).reshape(-1, 2).T
    return ticks_ns[: int(np.argmin(np.append(frames, -1) == np.arange(len(frames) + 1)))]


@contextmanager
def _running(
    keys: dict[str, Any], duration_s: float, run_dir: Path
) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "cpnet", "up", _SCENARIO, "--out", str(run_dir)]
    command += ["--mode", "lockstep", "--duration", f"{duration_s:g}"]
    for key, value in keys.items():
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
            raise ConfigError(f"the run did not begin:\n{_said(run_dir)}")
        time.sleep(_POLL_S)


def _said(run_dir: Path) -> str:
    return (run_dir.parent / "said").read_text("utf-8")


def _parts(way: str) -> list[str]:
    """Returns what is done at the same time in a way."""
    return way.split("+")


class _Looker:
    """A process that looks on in one way; see `cpnet.bench_looker`. A context manager."""

    def __init__(self, way: str, run_dir: Path, scratch: Path) -> None:
        command = [sys.executable, "-m", "cpnet.bench_looker", way, str(run_dir), str(scratch)]
        self._way = way
        self._looks = False
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

    def look(self, looks: bool) -> None:
        """Looks on from now on, or does so no more.

        Raises:
            ConfigError: the process has ended.
        """
        if looks != self._looks:
            self._looks = looks
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
