"""Input of `cpnet compare`: roads, demand, signals, sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from sim_host.setup import build_setup, config_file, sumo_files, traffic_config
from studies.compare_files import check_contents, check_flows, check_no_folders
from studies.control_file import CabinetTime
from studies.sumo_config import PAIRED_SETTINGS, SAME_FOR_ALL, write_config
from studies.sweep.cells import Resolve

POSTS, CAVS, BOTH = "posts", "CAVs", "posts and CAVs"
TUNING_SEEDS = (101, 102)
MIN_TUNING_S = 60
MAX_DEMAND_VPH = 3600
MAX_FRAME_PERIOD_S = 60
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
_CABINET_TIMES = {f"cabinet.{name}": name for name in get_args(CabinetTime)}


@dataclass(frozen=True, slots=True)
class Question:
    """Options of `cpnet compare`.

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
        """Checks the options without reading a file.

        Raises:
            ConfigError: options contradict each other, or there is no net or no demand.
        """
        check_no_folders(self.files)
        if self.net is None and self.sumocfg is None:
            raise ConfigError("--net X.net.xml or --sumocfg F is needed: which roads?")
        demands = {"--sumocfg": self.sumocfg, "--routes": self.routes, "--demand": self.demand_vph}
        given = [name for name, value in demands.items() if value is not None]
        if len(given) > 1:
            raise ConfigError(f"{' and '.join(given)}: give one of them, each is a demand")
        if not given:
            raise ConfigError(f"{self.net}: no demand. {_advice(self.net, self.tls)}")
        self._check_numbers()
        both = sorted(set(self.seeds) & set(TUNING_SEEDS))
        if both:
            raise ConfigError(f"--seeds: {both[0]} is a seed that baselines are tuned with")
        if 0 < self.tuning_s < MIN_TUNING_S:
            raise ConfigError(f"--tuning {self.tuning_s}: must be 0 or {MIN_TUNING_S} and more")
        if isinstance(self.posts, list) and len(self.posts) > 1:
            for word in {"all", "none"} & set(self.posts):
                raise ConfigError(f"--posts {','.join(self.posts)}: {word} stands alone")
        self._check_settings()

    def _check_settings(self) -> None:
        for key in self.settings or {}:
            if key in _RULED:
                raise ConfigError(f"--set {key}: give {_RULED[key]} instead")
            is_same = any(f"{key}.".startswith(f"{one}.") for one in SAME_FOR_ALL)
            if is_same and key not in _CABINET_TIMES:
                raise ConfigError(
                    f"--set {key}: is the same for all that is compared, and cannot be set here"
                )

    def _check_numbers(self) -> None:
        if self.demand_vph is not None and not 1 <= self.demand_vph <= MAX_DEMAND_VPH:
            raise ConfigError(
                f"--demand {self.demand_vph:g}: must be from 1 to {MAX_DEMAND_VPH} vehicles per "
                "hour and lane"
            )
        if not 0 < self.frame_period_s <= MAX_FRAME_PERIOD_S:
            raise ConfigError(
                f"--frame-period {self.frame_period_s:g}: must be more than 0 and at most "
                f"{MAX_FRAME_PERIOD_S} s"
            )

    @property
    def files(self) -> dict[str, Path | None]:
        """The files that are given, by their option."""
        return {"--net": self.net, "--sumocfg": self.sumocfg, "--routes": self.routes}

    @property
    def cabinet(self) -> dict[CabinetTime, float]:
        """Times of the cabinet that are set, for all but the net's own plan."""
        given = self.settings or {}
        return {name: given[key] for key, name in _CABINET_TIMES.items() if key in given}

    @property
    def common_settings(self) -> dict[str, Any]:
        """Keys of every scenario that is compared."""
        return {
            **PAIRED_SETTINGS,
            "frame_period_s": self.frame_period_s,
            "duration_s": self.duration_s,
            "traffic.warmup_s": self.warmup_s,
            **(self.settings or {}),
        }


def _advice(net: Path | None, tls: str | list[str] | None) -> str:
    """Returns how a demand is given; `--demand` goes with one signal only."""
    beside = sorted(net.parent.glob("*.sumocfg")) if net is not None else []
    found = f" (beside the net lies {beside[0]})" if beside else ""
    if isinstance(tls, list) and len(tls) > 1:
        return f"Give --sumocfg FILE{found} or --routes FILE.rou.xml"
    one = "with one signal " if tls == "all" else ""
    return (
        f"Give --sumocfg FILE{found}, --routes FILE.rou.xml, or {one}--demand N, vehicles per hour "
        "and lane"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A prepared comparison: roads with their demand as one sumocfg, and positions of posts."""

    question: Question
    name: str
    config: Path
    road_map: RoadMap
    posts: list[str]

    @property
    def sights(self) -> list[str]:
        """The kinds of sensors to compare: posts, CAVs, both, as far as there are any."""
        found = [POSTS] if self.posts else []
        found += [CAVS] if self.question.cav_rate > 0 else []
        return [*found, BOTH] if len(found) == 2 else found

    @property
    def lead_sight(self) -> str:
        """The kind of sensors that the answer is about: posts where there are any."""
        return self.sights[0]


def prepare(question: Question, folder: Path, name: str, resolve: Resolve) -> Comparison:
    """Reads the net, and writes roads and demand as one sumocfg into a folder.

    Raises:
        ConfigError: options contradict each other, a file is wrong, a signal is unknown.
    """
    question.check()
    check_contents(question.files)
    if question.routes is not None:
        check_flows(question.routes, question.warmup_s + question.duration_s)
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
    scenario = resolve(
        {**question.common_settings, **given, "junctions": question.tls, "name": name}
    )
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
