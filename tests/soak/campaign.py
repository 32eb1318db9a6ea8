"""`scripts/soak`: starts a realtime run, kills its processes, measures how long recovery takes."""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.markup import escape

from cpnet.cli_options import console, errors
from cpnet.endpoints import connecting, free_locator
from cpnet.supervisor import LIST_NAME
from protocol.bus import Endpoint
from protocol.errors import BusError, ConfigError, CpnetError
from tests.soak.findings import (
    Fault,
    Findings,
    Growth,
    Memory,
    kill,
    look_back,
    page,
    processes_of,
    victims_of,
)
from tests.soak.health import Health, Observer

GIVE_UP_S = 20.0
SAMPLE_S = 5.0


def hurt(
    observer: Observer,
    run_dir: Path,
    *,
    minutes: float,
    kills: int,
    rng: np.random.Generator,
    report: Callable[[Fault], None],
) -> tuple[list[Fault], list[Growth]]:
    """Kills so many processes in so many minutes, at random times; returns the faults.

    A process is killed once all is right; how long that stays so is drawn at random. Each fault is
    reported at once.
    """
    memory = Memory(run_dir)
    faults = []
    began_ns = time.monotonic_ns()
    pause_s = minutes * 60 / kills
    for number, victim in enumerate(victims_of(list(processes_of(run_dir)), kills, rng)):
        due_ns = began_ns + round((number + rng.uniform(0, 0.5)) * pause_s * 1e9)
        for left_s in _slices(due_ns):
            observer.listen(left_s)
            memory.sample()
        observer.listen(GIVE_UP_S, observer.is_right)
        faults.append(hurt_once(observer, run_dir, victim))
        report(faults[-1])
    return faults, memory.growth()


def hurt_once(
    observer: Observer, run_dir: Path, victim: str, timeout_s: float = GIVE_UP_S
) -> Fault:
    """Kills a process and waits until all is right again, at most so long."""
    health = observer.health
    frame = health.frame
    since_ns = time.monotonic_ns()
    kill(run_dir, victim)
    observer.listen(timeout_s, lambda: victim in health.absent())
    health.reset()
    observer.listen(timeout_s, observer.is_right)
    right_ns = health.right_since_ns
    if right_ns is None:
        return Fault(victim, frame, None, health.wrong)
    return Fault(victim, frame, (right_ns - since_ns) / 1e9)


def _slices(due_ns: int) -> Iterator[float]:
    while (left_ns := due_ns - time.monotonic_ns()) > 0:
        yield min(SAMPLE_S, left_ns / 1e9)


START_S = 120.0
POLL_S = 0.1
END_S = 300.0  # it reads all frames of the run for its summary
BEYOND_S = 600.0  # of the run's own duration: it is stopped before


def main(
    *,
    minutes: Annotated[float, typer.Option(help="how long to hurt it", min=0.1)] = 30,
    kills: Annotated[int, typer.Option(help="how many processes to kill", min=1)] = 200,
    seed: Annotated[int, typer.Option(help="of the victims and their times")] = 1,
    out: Annotated[Path, typer.Option(help="run folder")] = Path("runs/soak"),
    markdown: Annotated[Path | None, typer.Option(help="write the findings here, too")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="scenario keys")] = None,
) -> None:
    """Kill processes of a running loop at random and measure until all is right again."""
    try:
        findings = soak(minutes, kills, seed, out, set_ or [])
    except CpnetError as error:
        errors.print(f"[bold red]error[/] {escape(str(error))}", soft_wrap=True)
        raise typer.Exit(2) from None
    text = page(findings, shlex.join(["scripts/soak", *sys.argv[1:]]))
    console.print(text, markup=False, soft_wrap=True)
    if markdown is not None:
        markdown.write_text(text, "utf-8")
    raise typer.Exit(1 if findings.faults_found() else 0)


def soak(minutes: float, kills: int, seed: int, out: Path, keys: list[str]) -> Findings:
    """Runs the loop, hurts it, ends it and looks back.

    Raises:
        BusError: the run did not come up.
        ConfigError: its folder is there already, or holds no run.
    """
    if out.exists():
        raise ConfigError(f"--out {out}: is there already; needs a new folder")
    v2x, world = (Endpoint(free_locator(), listen=True) for _ in range(2))
    command = [sys.executable, "-m", "cpnet", "up", "t_junction", "--mode=realtime", "--restart"]
    command += [f"--duration={minutes * 60 + BEYOND_S:g}", f"--out={out}"]
    command += [
        f"--listen={bus}={e.locator.removeprefix('tcp/')}"
        for bus, e in (("v2x", v2x), ("world", world))
    ]
    command += [f"--set={key}" for key in keys]
    with subprocess.Popen(command) as run:
        try:
            with _observe(out, connecting(v2x), connecting(world), run) as observer:
                if not observer.listen(START_S, observer.is_right):
                    raise BusError(f"the run never went right: {observer.health.wrong}")
                rng = np.random.default_rng(seed)
                faults, memory = hurt(
                    observer, out, minutes=minutes, kills=kills, rng=rng, report=_report
                )
                asked = set(observer.asked)
        finally:
            run.send_signal(signal.SIGINT)
            run.wait(END_S)
    return look_back(out, minutes, faults, memory, asked)


def _report(fault: Fault) -> None:
    console.print(str(fault), markup=False, soft_wrap=True)


def _observe(
    run_dir: Path, v2x: Endpoint, world: Endpoint, run: subprocess.Popen[bytes]
) -> Observer:
    """Listens to a run that has just been started, once it can be."""
    until_ns = time.monotonic_ns() + round(START_S * 1e9)
    while not (run_dir / LIST_NAME).is_file():
        if run.poll() is not None or time.monotonic_ns() > until_ns:
            raise BusError(f"the run in {run_dir} did not start")
        time.sleep(POLL_S)
    scenario = json.loads((run_dir / "scenario.json").read_text("utf-8"))
    posts = {mount["id"] for mount in scenario["roadside_mounts"]}
    return Observer(v2x, world, Health(set(processes_of(run_dir)), posts))


if __name__ == "__main__":
    typer.run(main)
