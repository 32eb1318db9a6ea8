"""`cpnet bench uplink` and `rate`: the whole system on recorded traffic, a run for each case."""

from __future__ import annotations

import io
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from rich.console import Console

from cpnet.preparation import Options
from cpnet.scenario import load
from cpnet.up import up
from protocol.errors import ConfigError
from recording.run import Run
from sensing.link_config import NONE, profile_named
from sensing.recorded_scans import Recording
from sensing.upload_policies import NAMES, Filter
from studies.bench import FRAME_PERIOD_S, LINK_CHOICES, POLICY_CHOICES, SHARING, WARM_UP_FRAMES
from studies.bench_sharing import measure_sharing
from studies.bench_traffic import record_traffic, visible_vehicles
from studies.bench_uplink import RateRow, UplinkRow, row_of

RATES_HZ = (10.0, 15.0, 20.0, 24.0, 30.0, 36.0, 42.0, 50.0, 60.0, 75.0, 100.0)
_SCENARIO = "t_junction"
_PATIENT_MS = 5_000.0  # nothing is dropped for being late: latency shows it instead


@dataclass(frozen=True, slots=True)
class UplinkBench:
    """Parameters of the benchmark. In realtime, links are emulated at `rate_hz` frames a second."""

    policies: tuple[str, ...] = POLICY_CHOICES
    links: tuple[str, ...] = LINK_CHOICES
    agents: int = 6
    frames: int = 60
    realtime: bool = False
    rate_hz: float = 1 / FRAME_PERIOD_S

    def check(self) -> None:
        """Raises ConfigError if it cannot be measured."""
        if not 2 <= self.agents <= 16:
            raise ConfigError(f"--agents {self.agents}: must be 2 to 16")
        if not WARM_UP_FRAMES < self.frames <= 600:
            raise ConfigError(f"--frames {self.frames}: must be {WARM_UP_FRAMES + 1} to 600")
        _check_once("--policies", self.policies)
        _check_once("--link", self.links)
        if SHARING in self.policies and self.realtime:
            raise ConfigError(f"policy {SHARING!r} is measured over virtual links, not in realtime")
        for link in self.links:
            profile_named(link)
            for policy in self.policies:
                if policy != SHARING:
                    load(_SCENARIO, overrides(self, Path(), policy, link))


def _check_once(option: str, names: tuple[str, ...]) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            raise ConfigError(f"{option}: {name!r} stands {count} times, each may stand once")


def upload_of(policy: str) -> dict[str, Any]:
    """Returns the scenario keys of a policy with filters, written as `reap+foreground`.

    Raises:
        ConfigError: there is no such policy or filter.
    """
    name, *filters = policy.split("+")
    if not NAMES.has(name):
        raise ConfigError(f"policy {name!r}: must be one of {SHARING}, {NAMES.listed()}")
    _check_once(f"policy {policy!r}", tuple(filters))
    unknown = sorted(set(filters) - set(get_args(Filter)))
    if unknown:
        raise ConfigError(
            f"policy {policy!r}: filter {unknown[0]!r} must be one of {', '.join(get_args(Filter))}"
        )
    return {"upload.policy": name, "upload.filters": filters}


def measure(bench: UplinkBench) -> Iterator[UplinkRow]:
    """Yields a row for each policy on each link.

    Raises:
        ConfigError: what is asked for cannot be measured.
    """
    with _recorded(bench) as (scratch, traffic):
        cells = [(policy, link) for link in bench.links for policy in bench.policies]
        for number, (policy, link) in enumerate(cells):
            if policy == SHARING:
                yield measure_sharing(traffic, link, bench.frames)
            else:
                yield run_cell(bench, traffic, policy, link, scratch / f"{number}")


def measure_rates(bench: UplinkBench) -> Iterator[RateRow]:
    """Yields by policy the row of each rate in realtime without links, until one is too much.

    Raises:
        ConfigError: what is asked for cannot be measured.
    """
    bench = replace(bench, realtime=True, links=(NONE,))
    with _recorded(bench) as (scratch, traffic):
        for policy in bench.policies:
            for rate_hz in RATES_HZ:
                run_dir = scratch / f"{policy}-{rate_hz:g}"
                at_rate = replace(bench, rate_hz=rate_hz)
                row = RateRow(rate_hz, run_cell(at_rate, traffic, policy, NONE, run_dir))
                yield row
                if not row.is_sustained:
                    break


@contextmanager
def _recorded(bench: UplinkBench) -> Iterator[tuple[Path, Path]]:
    """Context manager: a temporary folder for the runs, with the recorded traffic of all."""
    bench.check()
    with tempfile.TemporaryDirectory(prefix="cpnet-bench-") as name:
        scratch = Path(name)
        traffic = scratch / "traffic"
        traffic.mkdir()
        record_traffic(traffic, bench.agents, bench.frames)
        yield scratch, traffic


def run_cell(bench: UplinkBench, traffic: Path, policy: str, link: str, run_dir: Path) -> UplinkRow:
    """Runs one policy on one link and reads its row.

    Raises:
        ConfigError: the run failed; the text holds what it printed.
    """
    output = io.StringIO()
    options = Options(_SCENARIO, overrides(bench, traffic, policy, link), None, [], [], run_dir)
    status, _ = up(options, Console(file=output))
    if status > 128:  # a signal asked for the end
        raise SystemExit(status)
    if status != 0:
        raise ConfigError(f"{policy} on {link} failed:\n{output.getvalue()}")
    return read_cell(bench, traffic, policy, link, run_dir)


def read_cell(
    bench: UplinkBench, traffic: Path, policy: str, link: str, run_dir: Path
) -> UplinkRow:
    """Returns the row of a run that is over."""
    recording, visible = Recording(traffic), visible_vehicles(traffic)
    with Run(run_dir) as run:
        return row_of(
            run,
            (policy, link),
            bench.agents,
            lambda frame: visible[recording.place(frame)],
            1 / bench.rate_hz,
        )


def overrides(bench: UplinkBench, traffic: Path, policy: str, link: str) -> dict[str, Any]:
    """Returns the scenario keys of a cell."""
    period_s = 1 / bench.rate_hz
    return {
        **upload_of(policy),
        "name": "bench",
        "mode": "realtime" if bench.realtime else "lockstep",
        "recording": str(traffic),
        "frame_period_s": period_s,
        "duration_s": bench.frames * period_s,
        "traffic.step_s": period_s,
        "traffic.warmup_s": 0,
        "link.profile": link,
        "link.roadside_profile": link,
        "edge.deadline_ms": _PATIENT_MS,
    }
