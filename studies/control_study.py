"""`cpnet study control`: signal policies against tuned baselines, with perfect positions.

Each baseline is tuned for each net and demand as its advocate would, on seeds apart from those that
are reported; then all policies drive the same traffic, seed by seed. Each run is kept at once: the
same command resumes with the remaining runs.
"""

from __future__ import annotations

import hashlib
import json
import math
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from statistics import mean, stdev
from typing import Any, Protocol, TypeVar

from scipy.special import stdtrit

from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from sim_host.setup import sumo_files
from studies.bench_control import lane_flows_vph, run_case_in_detail
from studies.control_baselines import TUNINGS, Tuning, worth_trying
from studies.control_case import OWN_PLAN, WEBSTER, ControlCase, roads_of
from studies.control_file import NETS, ControlStudy
from studies.run_pool import run_each
from studies.sweep.cells import code_digest, write_atomically

_ROOT = Path(__file__).resolve().parents[1]
_OWN_CODE = (
    "bench_control.py",
    "control_case.py",
    "control_run.py",
    "control_baselines.py",
    "approach_log.py",
)
_CONFIDENCE = 0.95
Row = dict[str, Any]
Report = Callable[[int, int, str], None]
"""Receives the number of runs done, of all, and the title of the last one, if any."""


@dataclass(frozen=True, slots=True)
class Group:
    """A net at a demand, on which policies are compared."""

    net: str
    demand: float

    @property
    def title(self) -> str:
        """Returns its name."""
        factor = f" x{self.demand:g}" if self.net in NETS else ""
        return Path(self.net).name.removesuffix(".sumocfg") + factor


def groups_of_study(study: ControlStudy) -> list[Group]:
    """Returns each net at each demand."""
    return [Group(net, demand) for net, factors in study.nets.items() for demand in factors]


class Case(Protocol):
    """A run that a `CaseStore` keeps."""

    @property
    def title(self) -> str:
        """Name of the run in the progress display."""

    def identity(self) -> dict[str, Any]:
        """Returns everything that determines the run's figures, as JSON values."""


C = TypeVar("C", bound=Case)
LOG_NAME = "runs.log"  # beside the cases: what runs print


@dataclass(frozen=True, slots=True)
class BenchCase:
    """A run of SUMO alone."""

    case: ControlCase

    @property
    def title(self) -> str:
        """See `Case`."""
        one = self.case
        return f"{Group(one.net, one.demand).title} {one.policy} seed={one.seed}"

    def identity(self) -> dict[str, Any]:
        """See `Case`."""
        net = self.case.net
        files = [] if net in NETS else files_of_net(Path(net))
        return {
            "case": asdict(self.case),
            "code": _code(),
            "files": {path.name: file_digest(path) for path in files},
        }


class CaseStore:
    """Stored runs of a folder, each a file that is named by a hash of its case and the code."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "cases"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out {folder}: {error}") from None

    def run(
        self, work: Callable[[C], Row], cases: Sequence[C], processes: int, report: Report
    ) -> list[Row]:
        """Returns the rows of cases, in their order; runs those that are missing.

        Args:
            work: a function of a module, which runs a case.
            cases: equal ones run once.
            processes: runs at a time, each in a process of its own as SUMO keeps state.
            report: called after each run, and before the first.

        Raises:
            ConfigError: a net or a policy is invalid, or a run's process was killed.
        """
        paths = [self._path(work.__name__, case) for case in cases]
        todo = {path: case for path, case in zip(paths, cases, strict=True) if _read(path) is None}
        report(len(cases) - len(todo), len(cases), "")
        kept = len(cases) - len(todo)
        missing = [*todo.items()]
        runs = run_each(work, [*todo.values()], processes, self._folder.parent / LOG_NAME)
        for count, (number, row) in enumerate(runs, kept + 1):
            path, case = missing[number]
            write_atomically(path, json.dumps(row, indent=1).encode())
            report(count, len(cases), case.title)
        return [_read(path) or {} for path in paths]

    def _path(self, kind: str, case: Case) -> Path:
        decides = {"kind": kind, **case.identity()}
        found = hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()
        return self._folder / f"{found[:16]}.json"


def run_row(one: BenchCase) -> Row:
    """Returns the figures of a run."""
    return run_case_in_detail(one.case)


def run_flows(one: BenchCase) -> Row:
    """Returns the vehicles per hour over each stop bar."""
    return lane_flows_vph(one.case)


def files_of_net(net: Path) -> list[Path]:
    """Returns the files that a .sumocfg names, itself first, or those of a folder with one."""
    if net.suffix != ".sumocfg":
        return sorted(net.glob("*.xml"))
    found = sumo_files(net)
    return [net, found.net, *found.others]


def _read(path: Path) -> Row | None:
    try:
        found = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


@cache
def _code() -> list[str]:
    own = [file_digest(Path(__file__).parent / name) for name in _OWN_CODE]
    return [code_digest(_ROOT, ("protocol", "sim_host", "signal_controller")), *own]


def file_digest(path: Path) -> str:
    """Returns a hash of a file's contents."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True, slots=True)
class SeedRows:
    """A control's figures: a row for each seed."""

    policy: str
    rows: list[Row]

    def values(self, measure: str) -> list[float]:
        """Returns a measure, seed by seed, where a run yields it."""
        return [float(row[measure]) for row in self.rows if row.get(measure) is not None]

    def mean(self, measure: str) -> float | None:
        """Returns a measure's mean over the seeds; None if no run yields it."""
        found = self.values(measure)
        return mean(found) if found else None

    def greatest(self, measure: str) -> float | None:
        """Returns a measure's greatest value of all seeds; None if no run yields it."""
        return max(self.values(measure), default=None)

    @property
    def delay_s(self) -> float:
        """Mean delay of a vehicle, over the seeds."""
        return mean(self.values("delay_s"))


@dataclass(frozen=True, slots=True)
class PolicyResult(SeedRows):
    """A policy in a group; `tuning` is the chosen tuning, if it has any."""

    group: Group
    tuning: Tuning | None


def run_control_study(
    study: ControlStudy,
    folder: Path,
    processes: int,
    report: Report,
    tunings: Mapping[str, Sequence[Tuning]] = TUNINGS,
) -> list[PolicyResult]:
    """Tunes, then runs all missing cases.

    Args:
        study: what to run.
        folder: of the results.
        processes: runs at a time.
        report: called after each run.
        tunings: the tunings that are tried for each policy.

    Raises:
        ConfigError: a net or a policy is invalid.
    """
    store = CaseStore(folder)
    groups = groups_of_study(study)
    flows = _flows(study, groups, store, processes, report)
    best = _tuned(study, groups, flows, store, processes, report, tunings)
    cells = [(group, policy) for group in groups for policy in study.policies]
    cases = [
        _case(study, *cell, flows, best.get(cell), seed) for cell in cells for seed in study.seeds
    ]
    rows = iter(store.run(run_row, [*map(BenchCase, cases)], processes, report))
    return [
        PolicyResult(policy, [next(rows) for _ in study.seeds], group, best.get((group, policy)))
        for group, policy in cells
    ]


Flows = Mapping[Group, Row]
Tunings = dict[tuple[Group, str], Tuning]
Tried = tuple[Group, str, Tuning]


def _flows(
    study: ControlStudy, groups: list[Group], store: CaseStore, processes: int, report: Report
) -> Flows:
    """Returns the flows that fixed plans are made for, by group, from a seed for tuning."""
    if WEBSTER not in study.policies:
        return {}
    seed = (study.tuning_seeds or study.seeds)[0]
    cases = [BenchCase(_case(study, group, OWN_PLAN, {}, None, seed)) for group in groups]
    return dict(zip(groups, store.run(run_flows, cases, processes, report), strict=True))


def _tuned(
    study: ControlStudy,
    groups: list[Group],
    flows: Flows,
    store: CaseStore,
    processes: int,
    report: Report,
    tunings: Mapping[str, Sequence[Tuning]],
) -> Tunings:
    """Returns the tuning of least mean delay for each baseline, over the seeds for tuning.

    All are tried in short runs, the finalists in runs as long as the reported ones: the best of
    many by a few short runs is often a lucky one.
    """
    if not study.tuning_seeds:
        report(0, 0, "")
        return {}
    roads = {group.net: _roads(study, group) for group in {one.net: one for one in groups}.values()}
    tried = [
        (group, policy, tuning)
        for group in groups
        for policy in study.policies
        for tuning in worth_trying(tunings.get(policy, ()), roads[group.net])
    ]

    def best_of(tried: list[Tried], kept: int, duration_s: int) -> list[Tried]:
        as_long = study.model_copy(update={"duration_s": duration_s})
        cases = [
            BenchCase(_case(as_long, group, policy, flows, tuning, seed))
            for group, policy, tuning in tried
            for seed in study.tuning_seeds
        ]
        rows = iter(store.run(run_row, cases, processes, report))
        delays_s = [mean(float(next(rows)["delay_s"]) for _ in study.tuning_seeds) for _ in tried]
        return _least(tried, delays_s, kept)

    found = best_of(tried, study.finals, study.tuning_duration_s)
    if study.finals > 1:
        found = best_of(found, 1, study.duration_s)
    return {(group, policy): tuning for group, policy, tuning in found}


def _least(tried: Sequence[Tried], delays_s: Sequence[float], kept: int) -> list[Tried]:
    """Returns so many tunings of least delay of each baseline in each group."""
    cells: dict[tuple[Group, str], list[tuple[float, Tried]]] = {}
    for delay_s, one in zip(delays_s, tried, strict=True):
        cells.setdefault(one[:2], []).append((delay_s, one))
    return [
        one for found in cells.values() for _, one in sorted(found, key=lambda pair: pair[0])[:kept]
    ]


def _roads(study: ControlStudy, group: Group) -> RoadMap:
    with tempfile.TemporaryDirectory(prefix="cpnet-control-") as folder:
        return roads_of(_case(study, group, OWN_PLAN, {}, None, 1), Path(folder))[1]


def _case(
    study: ControlStudy,
    group: Group,
    policy: str,
    flows: Flows,
    tuning: Tuning | None,
    seed: int,
) -> ControlCase:
    case = ControlCase(
        group.net,
        policy,
        seed,
        group.demand,
        study.duration_s,
        warmup_s=study.warmup_s,
        junctions=tuple(study.junctions),
        cabinet={str(name): value for name, value in study.cabinet.items()},
    )
    if policy == WEBSTER:
        case = replace(case, flows_vph=flows[group])
    return case if tuning is None else case.tuned(tuning)


@dataclass(frozen=True, slots=True)
class Difference:
    """A mean of paired differences and half the width of its 95 % interval, None of one pair."""

    mean: float
    half: float | None


def paired(values: Sequence[float], others: Sequence[float]) -> Difference:
    """Returns the mean paired difference of values, with its interval by Student's t."""
    differences = [a - b for a, b in zip(values, others, strict=True)]
    n = len(differences)
    if n < 2:
        return Difference(mean(differences), None)
    t = float(stdtrit(n - 1, (1 + _CONFIDENCE) / 2))
    return Difference(mean(differences), t * stdev(differences) / math.sqrt(n))


_MEANS = (
    *("delay_p95_s", "stops", "co2_g", "arrived", "vehicles"),
    *("e_cvpr", "uplink_mbps"),  # with perception alone
)


def summaries(study: ControlStudy, results: Iterable[PolicyResult]) -> list[Row]:
    """Returns a row for each group and policy, with its delay minus the studied policy's."""
    results = list(results)
    studied = {one.group: one for one in results if one.policy == study.studied}
    found = []
    for one in results:
        own = studied[one.group]
        difference = paired(own.values("delay_s"), one.values("delay_s"))
        is_other = one.policy != study.studied
        spread = paired(one.values("delay_s"), [0.0] * len(one.rows))
        found.append(
            {
                "net": Path(one.group.net).name,
                "demand": one.group.demand,
                "policy": one.policy,
                "setting": one.tuning.text if one.tuning else "",
                "seeds": len(one.rows),
                "delay_s": one.delay_s,
                "delay_ci95_s": spread.half,
                "waited_s": one.greatest("waited_s"),
                **{measure: one.mean(measure) for measure in _MEANS},
                "decide_p99_ms": one.greatest("decide_p99_ms"),
                "difference_s": difference.mean if is_other else None,
                "difference_ci95_s": difference.half if is_other else None,
                "difference_share": difference.mean / one.delay_s if is_other else None,
            }
        )
    return found
