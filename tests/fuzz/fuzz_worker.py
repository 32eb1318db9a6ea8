"""Feeds one target: with Atheris by what its inputs reach in the code, else by chance alone.

    python tests/fuzz/fuzz_worker.py TARGET --inputs 1000 --seed 1 --state FILE --findings FOLDER

Ends with 0 when all inputs were read, with 3 after a finding, whose text is the last line.
"""

from __future__ import annotations

import argparse
import faulthandler
import gc
import inspect
import logging
import os
import resource
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import deque
from pathlib import Path
from random import Random
from types import FunctionType, ModuleType
from typing import Any

from fuzz_targets import LIMIT_MS, MAX_INPUT_BYTES, TARGETS, Target
from fuzz_watch import Watch, forget_peak, peak_kib, virtual_kib

try:
    import atheris
except ModuleNotFoundError:
    atheris = None

FOUND = 3
_SLACK_MIB = 256  # for what the fuzzer itself keeps
_REMEMBERED = 256  # inputs between two looks at memory
_TRIES = 3
_GUIDED_BY = (
    "protocol",
    "sensing.link_config",
    "sensing.pcd",
    "sensing.ply",
    "sensing.point_files",
    "sensing.rec",
)


class Feeder:
    """Gives inputs to a target and ends the process at the first finding."""

    def __init__(self, target: Target, watch: Watch, findings: Path, *, timed: bool) -> None:
        self._target = target
        self._watch = watch
        self._findings = findings
        self._timed = timed
        self._last: deque[bytes] = deque(maxlen=_REMEMBERED)
        self._base_kib = 0

    def begin(self) -> None:
        """Bounds the memory from here on; what is there is no more looked at for garbage."""
        gc.freeze()
        forget_peak()
        self._base_kib = peak_kib()
        most = (virtual_kib() << 10) + ((self._target.most_mib + _SLACK_MIB) << 20)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))

    def feed(self, data: bytes) -> None:
        """Reads one input."""
        data = data[:MAX_INPUT_BYTES]
        watch = self._watch
        watch.begin(data)
        took_ns = self._time(data)
        if self._timed and took_ns > LIMIT_MS * 1e6:
            again_ns = min(self._time(data) for _ in range(_TRIES))
            if again_ns > LIMIT_MS * 1e6:
                self._report(data, f"took {again_ns / 1e6:.0f} ms of CPU time, limit {LIMIT_MS}")
            took_ns = again_ns
        watch.end(took_ns)
        self._last.append(data)
        if watch.inputs % _REMEMBERED == 0:
            self.look_at_memory()

    def look_at_memory(self) -> None:
        """Reports if the last inputs took more than one may."""
        grown_kib = peak_kib() - self._base_kib
        self._watch.note_memory(grown_kib)
        if grown_kib <= self._target.most_mib << 10:
            return
        for data in self._last:
            forget_peak()
            before_kib = peak_kib()
            self._time(data)
            if peak_kib() - before_kib > self._target.most_mib << 10:
                mib = (peak_kib() - before_kib) >> 10
                self._report(data, f"took {mib} MiB, limit {self._target.most_mib}")
        self.begin()  # the fuzzer grew, not the target

    def _time(self, data: bytes) -> int:
        begin_ns = time.thread_time_ns()
        try:
            self._target.takes(data)
        except BaseException:  # noqa: BLE001 - whatever it is, it is a finding
            self._report(data, traceback.format_exc(limit=-6))
        return time.thread_time_ns() - begin_ns

    def _report(self, data: bytes, text: str) -> None:
        path = save(self._findings, self._target.name, data)
        sys.stderr.write(f"\n{text}\nfound: {path}\n")
        sys.stderr.flush()
        os._exit(FOUND)


def save(folder: Path, name: str, data: bytes) -> Path:
    """Keeps an input; returns where."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}-{zlib.crc32(data):08x}"
    path.write_bytes(data)
    return path


def feed_by_chance(feeder: Feeder, target: Target, inputs: int, seed: int, until_ns: int) -> None:
    """Changes seeds again and again, and what came of them as long as it is good."""
    rng = Random(seed)
    seeds = target.seeds()
    for number in range(inputs):
        data = seeds[number] if number < len(seeds) else rng.choice(seeds)
        if number >= len(seeds):
            for _ in range(rng.choice((1, 1, 2, 4))):
                data = target.mutate(rng, data, seeds)
        feeder.feed(data)
        if time.monotonic_ns() > until_ns:
            return


def feed_guided(feeder: Feeder, target: Target, inputs: int, seed: int, seconds: int) -> None:
    """Lets libFuzzer choose which inputs to change; does not return."""
    seeds = target.seeds()
    kept = tempfile.mkdtemp(prefix="fuzz-")
    first = tempfile.mkdtemp(prefix="fuzz-")
    for number, data in enumerate(seeds):
        (Path(first) / f"{number:03}").write_bytes(data)
    instrument()

    begun = False

    def feed(data: bytes) -> None:
        nonlocal begun
        if not begun:  # what Atheris takes for itself is no part of what an input takes
            begun = True
            feeder.begin()
        feeder.feed(data)

    def mutate(data: bytes, most_bytes: int, number: int) -> bytes:
        rng = Random(number)
        if rng.random() < 0.1:
            return bytes(atheris.Mutate(data, most_bytes))
        return target.mutate(rng, data, seeds)[:most_bytes]

    options = [
        f"-runs={inputs}",
        f"-seed={seed % 0x7FFFFFFF or 1}",
        f"-max_len={MAX_INPUT_BYTES}",
        f"-max_total_time={seconds}",
        "-len_control=0",
        "-timeout=100000",
        "-rss_limit_mb=0",
        "-handle_segv=0",
        "-handle_abrt=0",
        "-handle_bus=0",
        "-handle_fpe=0",
        "-handle_ill=0",
        "-reload=0",
    ]
    atheris.Setup([sys.argv[0], *options, kept, first], feed, custom_mutator=mutate)
    atheris.Fuzz()


def instrument() -> None:
    """Has the code that reads tell Atheris where it has been; compiled loops cannot."""
    for name, module in sorted(sys.modules.items()):
        if name.startswith(_GUIDED_BY):
            for function in _functions(module):
                atheris.instrument_func(function)


def _functions(module: ModuleType) -> list[FunctionType]:
    found: list[FunctionType] = []
    holders: list[Any] = [module, *(c for c in vars(module).values() if inspect.isclass(c))]
    for holder in holders:
        for value in vars(holder).values():
            inner = getattr(value, "fget", None) or getattr(value, "__func__", None) or value
            if isinstance(inner, FunctionType) and inner.__module__ == module.__name__:
                found.append(inner)
    return found


def main() -> None:
    """Feeds the target that is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seconds", type=int, default=86_400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--state", type=Path, required=True)
    parser.add_argument("--findings", type=Path, required=True)
    options = parser.parse_args()
    faulthandler.enable()
    logging.disable()
    warnings.simplefilter("ignore")
    warnings.simplefilter("error", RuntimeWarning)
    target = TARGETS[options.target]
    checked = os.environ.get("NUMBA_BOUNDSCHECK") == "1"
    watch = Watch(options.state, new=not options.state.exists())
    feeder = Feeder(target, watch, options.findings, timed=not checked)
    for data in target.seeds():
        feeder.feed(data)  # what is loaded only once is no part of what an input takes
    until_ns = time.monotonic_ns() + options.seconds * 1_000_000_000
    if atheris is None or checked:
        feeder.begin()
        feed_by_chance(feeder, target, options.inputs, options.seed, until_ns)
        feeder.look_at_memory()
    else:
        feed_guided(feeder, target, options.inputs, options.seed, options.seconds)


if __name__ == "__main__":
    main()
