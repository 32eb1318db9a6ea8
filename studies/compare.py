"""`cpnet compare`: what a city's own junctions gain from LiDAR, against tuned timers and loops.

Fixed plans and actuated control run on SUMO alone, tuned as `cpnet study control` does; max
pressure and the predictive policy run on what roadside posts, CAVs or both perceive, in a process
each. All take the same demand, seed by seed, the same warm-up on the net's own plan and the same
measure: time loss plus departure delay of all vehicles, those still on the way and those kept
outside too.
"""

from __future__ import annotations

import json
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean
from typing import Any
from xml.etree import ElementTree

import numpy as np

from protocol.config import is_file
from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from recording.run import Run
from recording.tables import TruthRow
from sim_host.netfile import open_file
from sim_host.setup import build_setup, config_file, sumo_files, traffic_config
from studies.approach_log import ApproachLog, VehicleSample
from studies.bench_control import delays_s
from studies.control_baselines import TUNINGS, Tuning
from studies.control_file import ControlStudy
from studies.control_study import (
    CaseStore,
    Report,
    Row,
    file_digest,
    files_of_net,
    run_control_study,
)
from studies.in_process import run_in_process
from studies.page.model import MapChart
from studies.run_sections import map_section
from studies.sweep.cells import Resolve, Scenario, identify
from studies.sweep.worker import measure

POSTS, CAVS, BOTH, ALL_KNOWN = "posts", "CAVs", "posts and CAVs", "every vehicle"
PLAN, WEBSTER, ACTUATED = "plan", "webster", "actuated"
MAX_PRESSURE, PREDICTIVE = "max_pressure", "predictive"
BASELINES = (PLAN, WEBSTER, ACTUATED)
POLICIES = (MAX_PRESSURE, PREDICTIVE)
STAGES = ("demand", "tuning", "baselines", "perception")
_TUNING_SEEDS = (101, 102)
_MIN_TUNING_S = 60
_POST = "post"
_RULED = {
    "seed": "--seeds",
    "duration_s": "--duration",
    "frame_period_s": "--frame-period",
    "junctions": "--tls",
    "roadside_mounts": "--posts",
    "traffic.cav_rate": "--cav-rate",
    "traffic.warmup_s": "--warmup",
    "traffic.net": "--net",
    "traffic.routes": "--routes",
    "traffic.sumocfg": "--sumocfg",
    "traffic.default_demand_vph_per_lane": "--demand",
}
"""Keys of a scenario that options of the command set."""
_SAME_FOR_ALL = (
    *("mode", "cabinet", "traffic.step_s", "traffic.lateral.lane_change_s"),
    "traffic.pedestrians_per_hour",
)
"""Keys that would change SUMO or the cabinet in a part of the runs only."""
_TUNED: Mapping[str, Sequence[Tuning]] = {
    WEBSTER: TUNINGS[WEBSTER],
    ACTUATED: TUNINGS[ACTUATED],
    MAX_PRESSURE: [one for one in TUNINGS[MAX_PRESSURE] if not one.own.get("hold_s")],
}


@dataclass(frozen=True, slots=True)
class Question:
    """What the user asks for.

    Attributes:
        net, sumocfg, routes: files of SUMO; a sumocfg names its own net.
        demand_vph: vehicles per hour and lane, of one signal.
        tls: "all", ids, or None for the only signal of the net.
        posts: "all", "none" or ids of signals with a roadside LiDAR.
        cav_rate: share of vehicles with LiDAR and radio.
        seeds: of traffic, paired; others than those for tuning.
        duration_s, warmup_s, tuning_s: simulated time of a run, before it, and of one for tuning;
            0: nothing is tuned.
        frame_period_s: between scans, and between decisions.
        settings: dotted keys of the scenario.
    """

    net: Path | None = None
    sumocfg: Path | None = None
    routes: Path | None = None
    demand_vph: float | None = None
    tls: str | list[str] | None = None
    posts: str | list[str] = "all"
    cav_rate: float = 0.05
    seeds: tuple[int, ...] = (1, 2, 3)
    duration_s: int = 600
    warmup_s: int = 120
    tuning_s: int = 600
    frame_period_s: float = 1.0
    settings: Mapping[str, Any] | None = None

    def check(self) -> None:
        """Checks what can be known without reading a file.

        Raises:
            ConfigError: options contradict each other, or there is no net or no demand.
        """
        if self.net is None and self.sumocfg is None:
            raise ConfigError("--net X.net.xml or --sumocfg F is needed: which roads?")
        demands = {"--sumocfg": self.sumocfg, "--routes": self.routes, "--demand": self.demand_vph}
        given = [name for name, value in demands.items() if value is not None]
        if len(given) > 1:
            raise ConfigError(f"{' and '.join(given)}: give one of them, each is a demand")
        if not given:
            raise ConfigError(f"{self.net}: no demand. {_advice(self.net)}")
        both = sorted(set(self.seeds) & set(_TUNING_SEEDS))
        if both:
            raise ConfigError(f"--seeds: {both[0]} is a seed that baselines are tuned with")
        if 0 < self.tuning_s < _MIN_TUNING_S:
            raise ConfigError(f"--tuning {self.tuning_s}: must be 0 or {_MIN_TUNING_S} and more")
        for key in self.settings or {}:
            if key in _RULED:
                raise ConfigError(f"--set {key}: give {_RULED[key]} instead")
            if any(f"{key}.".startswith(f"{one}.") for one in _SAME_FOR_ALL):
                raise ConfigError(
                    f"--set {key}: is the same for all that is compared, and cannot be set here"
                )


def _advice(net: Path | None) -> str:
    beside = sorted(net.parent.glob("*.sumocfg")) if net is not None else []
    found = f" (beside the net lies {beside[0]})" if beside else ""
    return (
        f"Give --sumocfg FILE{found}, --routes FILE.rou.xml, or --demand N, vehicles per hour and "
        "lane"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """What is run: the roads with their demand as one sumocfg, and where posts stand."""

    question: Question
    name: str
    config: Path
    road_map: RoadMap
    posts: list[str]

    @property
    def sights(self) -> list[str]:
        """What perception is compared with: posts, CAVs, both, as far as there are any."""
        found = [POSTS] if self.posts else []
        found += [CAVS] if self.question.cav_rate > 0 else []
        return [*found, BOTH] if len(found) == 2 else found

    @property
    def lead_sight(self) -> str:
        """What the answer's sentence is about: posts where there are any."""
        return self.sights[0]


def prepare(question: Question, folder: Path, name: str, resolve: Resolve) -> Comparison:
    """Reads the net, and writes roads and demand as one sumocfg into a folder.

    Raises:
        ConfigError: the question contradicts itself, a file is wrong, a signal is unknown.
    """
    question.check()
    traffic: dict[str, Any] = {
        "traffic.net": question.net,
        "traffic.routes": question.routes,
        "traffic.sumocfg": question.sumocfg,
        "traffic.default_demand_vph_per_lane": question.demand_vph,
    }
    if question.sumocfg is not None:
        _check_same_net(question.net, question.sumocfg)
        traffic["traffic.net"] = None
    given = {key: one for key, one in traffic.items() if one is not None}
    given = {
        key: str(one.resolve()) if isinstance(one, Path) else one for key, one in given.items()
    }
    scenario = resolve({**_of_all(question), **given, "junctions": question.tls, "name": name})
    setup = build_setup(scenario, folder)
    signals = len(setup.road_map.intersections)
    if question.demand_vph is not None and signals > 1:
        raise ConfigError(
            f"--demand: goes with one signal, and --tls chooses {signals}; "
            "give --routes or --sumocfg"
        )
    config = folder / f"{name}.sumocfg"
    write_config(config_file(traffic_config(setup.scenario), folder), config)
    known = sorted(setup.road_map.by_tls)
    comparison = Comparison(question, name, config, setup.road_map, _posts(question.posts, known))
    if not comparison.sights:
        raise ConfigError("--posts none and --cav-rate 0: nobody sees anything; give one of them")
    return comparison


def _check_same_net(net: Path | None, sumocfg: Path) -> None:
    named = sumo_files(sumocfg).net
    if net is not None and net.resolve() != named.resolve():
        raise ConfigError(
            f"--net {net}: {sumocfg} names another net, {named}; --net can be left out"
        )


def _posts(asked: str | list[str], known: list[str]) -> list[str]:
    if asked == "all":
        return known
    if asked == "none":
        return []
    for tls in asked:
        if tls not in known:
            raise ConfigError(
                f"--posts {tls}: is none of the controlled signals: {', '.join(known[:20])}"
            )
    return list(asked)


_SHORT = {"n": "net-file", "r": "route-files", "a": "additional-files", "b": "begin", "e": "end"}
_FILES = ("net-file", "route-files", "additional-files")


def write_config(source: Path, target: Path, trips: Path | None = None) -> None:
    """Writes a sumocfg anew: files by absolute paths, nobody teleported, no other outputs.

    Args:
        source: the user's, or a generated one.
        target: a file in any folder.
        trips: where SUMO is to write every journey, also those that have not ended or begun.

    Raises:
        ConfigError: the source is no sumocfg.
    """
    try:
        with open_file(source) as stream:
            leaves = [one for one in ElementTree.parse(stream).getroot().iter() if not len(one)]
    except (ElementTree.ParseError, OSError) as error:
        raise ConfigError(f"{source}: cannot be read as XML: {error}") from None
    options: dict[str, str] = {}
    for one in leaves:
        value = one.get("value", one.get("v"))
        name = _SHORT.get(one.tag, one.tag)
        if value is not None and "output" not in name and not name.startswith("gui"):
            options[name] = _absolute(value, source.parent) if name in _FILES else value
    options["time-to-teleport"] = "-1"
    if trips is not None:
        options |= {
            "tripinfo-output": str(trips),
            "tripinfo-output.write-unfinished": "true",
            "tripinfo-output.write-undeparted": "true",
        }
    root = ElementTree.Element("configuration")
    for name, value in options.items():
        ElementTree.SubElement(root, name, value=value)
    ElementTree.ElementTree(root).write(target)


def _absolute(names: str, folder: Path) -> str:
    return ",".join(
        str((folder / one.strip()).resolve()) for one in names.split(",") if one.strip()
    )


def _of_all(question: Question) -> dict[str, Any]:
    """Returns the keys of every scenario."""
    return {
        "realism": "clear",
        "mode": "lockstep",
        "frame_period_s": question.frame_period_s,
        "duration_s": question.duration_s,
        "traffic.warmup_s": question.warmup_s,
        "traffic.lateral.lane_change_s": 0,  # SUMO is the same in all runs
        "traffic.pedestrians_per_hour": 0,  # baselines have nobody who stops vehicles that turn
        **(question.settings or {}),
    }


@dataclass(frozen=True, slots=True)
class PerceivedCase:
    """A run with perception; `draws` keeps where vehicles were seen and missed."""

    title: str
    scenario: Scenario
    draws: bool

    def identity(self) -> dict[str, Any]:
        """See `studies.control_study.Case`."""
        own = [Path(__file__).parent / name for name in ("compare.py", "approach_log.py")]
        return {
            "run": identify(self.scenario),
            "files": [
                file_digest(one) for one in files_of_net(_config_of(self.scenario)) if is_file(one)
            ],
            "code": [file_digest(one) for one in own],
            "draws": self.draws,
        }


def _config_of(scenario: Scenario) -> Path:
    return Path(scenario["traffic"]["sumocfg"])


def run_perceived(case: PerceivedCase) -> Row:
    """Runs a scenario with perception in this process; returns its figures.

    Raises:
        ConfigError: the scenario cannot be run.
    """
    with tempfile.TemporaryDirectory(prefix="cpnet-compare-") as name:
        folder = Path(name)
        config, trips, run_dir = folder / "world.sumocfg", folder / "trips.xml", folder / "run"
        write_config(_config_of(case.scenario), config, trips)
        run_dir.mkdir()
        traffic = {**case.scenario["traffic"], "sumocfg": str(config)}
        run_in_process({**case.scenario, "traffic": traffic}, run_dir)
        with Run(run_dir) as run:
            ((first_ns,),) = run.query("SELECT min(sim_time_ns) FROM frames")
            log = _log_of(run, first_ns)
            found = {**measure(run_dir).row, **log.as_json()}
            if case.draws:
                found["map"] = _map_points(run)
        delays, arrived = delays_s(trips, first_ns / 1e9)
    return {
        **found,
        "delay_s": mean(delays) if delays else 0.0,
        "delay_p95_s": float(np.quantile(delays, 0.95)) if delays else 0.0,
        "vehicles": len(delays),
        "arrived": arrived,
    }


def _log_of(run: Run, first_ns: int) -> ApproachLog:
    log = ApproachLog(run.setup.road_map, float(run.scenario["frame_period_s"]))
    times_ns = dict(run.query("SELECT frame, sim_time_ns FROM frames"))
    frames: dict[int, list[VehicleSample]] = defaultdict(list)
    for row in run.rows(TruthRow):
        sample = VehicleSample(row.vehicle, row.lane, row.lane_position_m, row.speed_mps)
        frames[row.frame].append(sample)
    for frame, samples in frames.items():
        log.note(((times_ns[frame] or first_ns) - first_ns) / 1e9, samples)
    return log


def _map_points(run: Run) -> list[dict[str, Any]]:
    """Returns the points of the map of a run, as `Points` has them."""
    charts = [block for block in map_section(run).blocks if isinstance(block, MapChart)]
    found: list[dict[str, Any]] = json.loads(
        json.dumps([asdict(p) for c in charts for p in c.points])
    )
    return found


@dataclass(frozen=True, slots=True)
class Variant:
    """A way to control the signals: what chooses, from what it sees, and a row for each seed.

    `sight` is empty for what sees nothing but loops; `setting` is what its tuning chose.
    """

    policy: str
    sight: str
    setting: str
    rows: list[Row]

    @property
    def is_perceived(self) -> bool:
        """Whether it acts on what LiDARs see."""
        return self.sight in (POSTS, CAVS, BOTH)

    def values(self, measure: str) -> list[float]:
        """Returns a measure, seed by seed, where a run yields it."""
        return [float(row[measure]) for row in self.rows if row.get(measure) is not None]

    def mean(self, measure: str) -> float | None:
        """Returns a measure's mean over the seeds; None if no run yields it."""
        found = self.values(measure)
        return mean(found) if found else None

    @property
    def delay_s(self) -> float:
        """Mean delay of a vehicle, over the seeds."""
        return mean(self.values("delay_s"))


def run_comparison(
    comparison: Comparison, folder: Path, processes: int, report: Report, resolve: Resolve
) -> list[Variant]:
    """Runs what is missing: demand, tuning, baselines, then perception (`STAGES`).

    Raises:
        ConfigError: a run cannot be made, or no vehicle drives.
    """
    results = run_control_study(_baselines(comparison), folder, processes, report, _TUNED)
    found = [
        Variant(
            one.policy,
            "" if one.policy in BASELINES else ALL_KNOWN,
            one.tuning.text if one.tuning else "",
            one.rows,
        )
        for one in results
    ]
    if not any(row["vehicles"] for row in found[0].rows):
        asked = comparison.question
        raise ConfigError(
            f"{comparison.name}: no vehicle drives in the {asked.warmup_s + asked.duration_s} s "
            "after the beginning of the demand"
        )
    fences = {one.policy: one.tuning for one in results if one.tuning}
    cells = [(policy, sight) for policy in POLICIES for sight in comparison.sights]
    cases = [
        case
        for policy, sight in cells
        for case in perceived_cases(comparison, policy, sight, fences.get(policy), resolve)
    ]
    rows = CaseStore(folder).run(run_perceived, cases, processes, report)
    count = len(comparison.question.seeds)
    for number, (policy, sight) in enumerate(cells):
        fence = fences.get(policy)
        own = rows[number * count : (number + 1) * count]
        found.append(Variant(policy, sight, fence.text if fence else "", own))
    return found


def _baselines(comparison: Comparison) -> ControlStudy:
    asked = comparison.question
    return ControlStudy(
        name=comparison.name,
        nets={str(comparison.config): [1.0]},
        policies=[*BASELINES, *POLICIES],
        seeds=list(asked.seeds),
        tuning_seeds=list(_TUNING_SEEDS) if asked.tuning_s else [],
        duration_s=asked.duration_s,
        warmup_s=asked.warmup_s,
        tuning_duration_s=max(_MIN_TUNING_S, asked.tuning_s),
        junctions=sorted(comparison.road_map.by_tls),
    )


def perceived_cases(
    comparison: Comparison, policy: str, sight: str, fence: Tuning | None, resolve: Resolve
) -> Iterator[PerceivedCase]:
    """Yields the runs of a policy that acts on what LiDARs see, one for each seed."""
    asked = comparison.question
    mounts = comparison.posts if sight != CAVS else []
    settings: dict[str, Any] = {
        "name": comparison.name,
        "junctions": sorted(comparison.road_map.by_tls),
        "traffic.sumocfg": str(comparison.config),
        "traffic.cav_rate": 0 if sight == POSTS else asked.cav_rate,
        "roadside_mounts": [{"id": f"{_POST}-{n}", "tls": tls} for n, tls in enumerate(mounts)],
        "signal.policy": policy,
    }
    if fence is not None:
        settings |= {"edge.upstream_m": fence.upstream_m, "edge.downstream_m": fence.downstream_m}
    for seed in asked.seeds:
        title = f"{comparison.name} {policy} {sight} seed={seed}"
        scenario = resolve({**_of_all(asked), **settings, "seed": seed})
        draws = policy == PREDICTIVE and seed == asked.seeds[0]
        yield PerceivedCase(title, scenario, draws)


def weights(comparison: Comparison) -> dict[str, tuple[int, float]]:
    """Returns by stage how many runs it has, and about how much work each is."""
    asked = comparison.question
    seeds, whole_s = len(asked.seeds), asked.warmup_s + asked.duration_s
    tried = sum(map(len, _TUNED.values())) * len(_TUNING_SEEDS) if asked.tuning_s else 0
    frames = asked.duration_s / asked.frame_period_s
    numbers = (
        (1, whole_s),
        (tried, asked.warmup_s + asked.tuning_s),
        (len((*BASELINES, *POLICIES)) * seeds, whole_s),
        (len(POLICIES) * len(comparison.sights) * seeds, _FRAME_WORK * frames + whole_s),
    )
    return dict(zip(STAGES, numbers, strict=True))


_FRAME_WORK = 10.0  # of a frame with perception, over a second of SUMO alone
