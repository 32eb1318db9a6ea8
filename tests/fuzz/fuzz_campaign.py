"""Fuzzing campaign: feeds all targets, each in processes of its own, and reports the results.

    scripts/fuzz --messages 10000000 --seed 1
    scripts/fuzz --replay TARGET FILE

Half of what a reader with compiled loops gets goes to loops that check every index. A finding ends
the campaign: its input lies in `runs/fuzz/findings`, with what to call to see it again.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from fuzz_targets import HANG_S, LIMIT_MS, TARGETS
from fuzz_watch import Watch
from fuzz_worker import FOUND, atheris, save

ROOT = Path(__file__).parents[2]
WORK = Path("runs") / "fuzz"
FINDINGS = WORK / "findings"
_WORKER = Path(__file__).parent / "fuzz_worker.py"
_CHECKED = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(WORK / "checked-loops")}
_REACHED = re.compile(r"(?:INITED|DONE).*?cov: (\d+) ft: \d+ corp: (\d+)/")
_POLL_S = 0.1


@dataclass(slots=True)
class Job:
    """One process's work: so many inputs for a target."""

    target: str
    checked: bool
    inputs: int
    seed: int
    seconds: int
    process: subprocess.Popen[bytes] | None = None
    finding: str = ""
    state: Path = field(init=False)

    def __post_init__(self) -> None:
        self.state = WORK / f"{self.target}{'-checked' if self.checked else ''}.state"
        Watch(self.state, new=True)

    @property
    def log(self) -> Path:
        """What the process wrote."""
        return self.state.with_suffix(".log")

    @property
    def how(self) -> str:
        """Method of choosing inputs."""
        if self.checked:
            return "indices checked"
        return "by chance" if atheris is None else "guided"

    def start(self) -> None:
        """Begins."""
        command = [sys.executable, str(_WORKER), self.target]
        for name in ("inputs", "seed", "seconds", "state"):
            command += [f"--{name}", str(getattr(self, name))]
        command += ["--findings", str(FINDINGS)]
        environment = os.environ | {"PYTHONHASHSEED": "0"} | (_CHECKED if self.checked else {})
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)

    def is_over(self) -> bool:
        """Returns whether the process has ended; ends it if it hangs."""
        assert self.process is not None
        watch = Watch(self.state)
        if (code := self.process.poll()) is not None:
            self.finding = self._judge(code, watch)
            return True
        if watch.begun_ns and time.monotonic_ns() - watch.begun_ns > HANG_S * 1e9:
            self.stop(signal.SIGABRT)  # it writes where it is
            path = save(FINDINGS, self.target, watch.input)
            self.finding = f"hangs for more than {HANG_S} s: {path}"
            return True
        return False

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Ends the process."""
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(number)
            self.process.wait(10)

    def reached(self) -> tuple[str, str]:
        """Returns how many places in the code, and how many inputs that differ, first and last."""
        found = _REACHED.findall(self.log.read_text(errors="replace"))
        if len(found) < 2:
            return "", ""
        return (f"{found[0][0]} > {found[-1][0]}", f"{found[0][1]} > {found[-1][1]}")

    def _judge(self, code: int, watch: Watch) -> str:
        if code == 0:
            return ""
        if code == FOUND:
            return self.log.read_text(errors="replace").splitlines()[-1]
        path = save(FINDINGS, self.target, watch.input)
        return f"the process ended with {code} ({self.log}): {path}"


def jobs_of(messages: int, minutes: float, seed: int, side_by_side: int) -> list[Job]:
    """Returns what is to be done, each target by its weight."""
    total = sum(target.weight for target in TARGETS.values())
    jobs = []
    for target in TARGETS.values():
        kinds = (False, True) if target.compiled else (False,)
        share = target.weight / total / len(kinds)
        seconds = max(1, round(minutes * 60 * side_by_side * share))
        inputs = -int(-messages * share // 1)
        jobs += [Job(target.name, checked, inputs, seed, seconds) for checked in kinds]
    return jobs


def run(jobs: list[Job], side_by_side: int) -> Iterator[Job]:
    """Yields jobs as they end; a finding stops all others."""
    waiting, running = jobs[::-1], list[Job]()
    try:
        while waiting or running:
            while waiting and len(running) < side_by_side:
                running.append(waiting.pop())
                running[-1].start()
            time.sleep(_POLL_S)
            for job in [job for job in running if job.is_over()]:
                running.remove(job)
                yield job
                if job.finding:
                    return
    finally:
        for job in running:
            job.stop()


def line(job: Job) -> str:
    """Returns what came of a job, as a row of the table."""
    watch, (places, kept) = Watch(job.state), job.reached()
    most = TARGETS[job.target].most_mib
    return (
        f"{job.target:22} {job.how:15} {watch.inputs:>10,} {places:>10} {kept:>10} "
        f"{watch.slowest_ns / 1e6:>8.2f} {watch.quantile_ms(0.999):>8.2f} "
        f"{watch.most_kib / 1024:>6.1f} of {most:>3}  {job.finding or 'good'}\n"
    )


def replay(name: str, path: Path) -> int:
    """Reads one input and prints the result."""
    begin_ns = time.thread_time_ns()
    try:
        good = TARGETS[name].takes(path.read_bytes())
    except Exception:  # noqa: BLE001 - that is what is looked for
        sys.stdout.write(traceback.format_exc())
        return 1
    took_ms = (time.thread_time_ns() - begin_ns) / 1e6
    sys.stdout.write(f"{'good' if good else 'refused'}, {took_ms:.1f} ms\n")
    return int(took_ms > LIMIT_MS)


def main() -> int:
    """Runs a campaign and returns 1 if something was found."""
    parser = argparse.ArgumentParser(prog="scripts/fuzz", description=__doc__)
    parser.add_argument("--messages", type=int, default=10_000_000, help="of all targets together")
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after so long, roughly")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at once")
    parser.add_argument("--only", nargs="+", choices=TARGETS, help="these targets' share alone")
    parser.add_argument("--replay", nargs=2, metavar=("TARGET", "FILE"), help="read one input")
    options = parser.parse_args()
    if options.replay:
        return replay(options.replay[0], Path(options.replay[1]).resolve())
    os.chdir(ROOT)
    WORK.mkdir(parents=True, exist_ok=True)
    begin_ns = time.monotonic_ns()
    write = sys.stdout.write
    write(
        f"{'target':22} {'inputs chosen':15} {'inputs':>10} {'places':>10} {'corpus':>10} "
        f"{'max ms':>8} {'p99.9':>8} {'peak MiB':>13}  verdict\n"
    )
    total, findings = 0, []
    jobs = jobs_of(options.messages, options.minutes, options.seed, options.jobs)
    jobs = [job for job in jobs if job.target in (options.only or TARGETS)]
    for job in run(jobs, options.jobs):
        write(line(job))
        sys.stdout.flush()
        total += Watch(job.state).inputs
        if job.finding:
            findings.append(f"{job.finding}\nscripts/fuzz --replay {job.target} FILE\n")
    minutes = (time.monotonic_ns() - begin_ns) / 60e9
    write(f"{total:,} inputs in {minutes:.1f} minutes, seed {options.seed}; limit {LIMIT_MS} ms\n")
    write("".join(findings) or "nothing found\n")
    return int(bool(findings))


if __name__ == "__main__":
    sys.exit(main())
