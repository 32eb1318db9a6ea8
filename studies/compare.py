"""`cpnet compare`: benefit of LiDAR at a user's junctions, against tuned fixed plans and loops.

Fixed plans and actuated control run on SUMO alone, tuned as `cpnet study control` does; max
pressure and the predictive policy run on what roadside posts, CAVs or both perceive, in a process
each. All take the same demand, seed by seed, the same warm-up on the net's own plan and the same
measure: time loss plus departure delay of all vehicles, those still on the way and those kept
outside too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError
from studies.compare_question import BOTH, CAVS, MIN_TUNING_S, POSTS, TUNING_SEEDS, Comparison
from studies.control_baselines import TUNINGS, Tuning, worth_trying
from studies.control_file import ControlStudy
from studies.control_study import CaseStore, Report, SeedRows, run_control_study
from studies.perceived_case import PerceivedCase, run_perceived
from studies.post_places import post_mounts
from studies.sweep.cells import Resolve

ALL_KNOWN = "every vehicle"
PLAN, WEBSTER, ACTUATED = "plan", "webster", "actuated"
MAX_PRESSURE, PREDICTIVE = "max_pressure", "predictive"
BASELINES = (PLAN, WEBSTER, ACTUATED)
POLICIES = (MAX_PRESSURE, PREDICTIVE)
STAGES = ("demand", "tuning", "baselines", "perception")
_FRAME_WORK = 10.0  # of a frame with perception, over a second of SUMO alone
_TUNED: Mapping[str, Sequence[Tuning]] = {
    policy: TUNINGS[policy] for policy in (WEBSTER, ACTUATED, MAX_PRESSURE)
}


@dataclass(frozen=True, slots=True)
class Variant(SeedRows):
    """A control of the signals: policy, its sensors, and a row for each seed.

    `sight` is empty without LiDAR; `setting` is the result of its tuning.
    """

    sight: str
    setting: str

    @property
    def is_perceived(self) -> bool:
        """Whether it acts on LiDAR perception."""
        return self.sight in (POSTS, CAVS, BOTH)


def run_comparison(
    comparison: Comparison, folder: Path, processes: int, report: Report, resolve: Resolve
) -> list[Variant]:
    """Runs the missing runs: demand, tuning, baselines, then perception (`STAGES`).

    Raises:
        ConfigError: a run cannot be made, or no vehicle drives.
    """
    study = _baselines(comparison)
    study.check()
    results = run_control_study(study, folder, processes, report, _TUNED)
    found = [
        Variant(
            one.policy,
            one.rows,
            "" if one.policy in BASELINES else ALL_KNOWN,
            one.tuning.text if one.tuning else "",
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
    sights = comparison.sights
    cells = [(policy, sight) for policy in POLICIES for sight in sights]
    longest_first = sorted(cells, key=lambda cell: -sights.index(cell[1]))  # no core idles long
    cases = {
        (policy, sight): [*perceived_cases(comparison, policy, sight, fences.get(policy), resolve)]
        for policy, sight in longest_first
    }
    rows = iter(CaseStore(folder).run(run_perceived, [*chain(*cases.values())], processes, report))
    own = {cell: [*islice(rows, len(runs))] for cell, runs in cases.items()}
    for policy, sight in cells:
        fence = fences.get(policy)
        found.append(Variant(policy, own[policy, sight], sight, fence.text if fence else ""))
    return found


def _baselines(comparison: Comparison) -> ControlStudy:
    asked = comparison.question
    return ControlStudy(
        name=comparison.name,
        nets={str(comparison.config): [1.0]},
        policies=[*BASELINES, *POLICIES],
        seeds=list(asked.seeds),
        tuning_seeds=list(TUNING_SEEDS) if asked.tuning_s else [],
        duration_s=asked.duration_s,
        warmup_s=asked.warmup_s,
        tuning_duration_s=max(MIN_TUNING_S, asked.tuning_s),
        finalists=1,
        junctions=sorted(comparison.road_map.by_tls),
        cabinet=asked.cabinet,
    )


def perceived_cases(
    comparison: Comparison, policy: str, sight: str, fence: Tuning | None, resolve: Resolve
) -> Iterator[PerceivedCase]:
    """Yields the runs of a policy that acts on LiDAR perception, one for each seed."""
    asked = comparison.question
    mounts = comparison.posts if sight != CAVS else []
    settings: dict[str, Any] = {
        "name": comparison.name,
        "junctions": sorted(comparison.road_map.by_tls),
        "traffic.sumocfg": str(comparison.config),
        "traffic.cav_rate": 0 if sight == POSTS else asked.cav_rate,
        "roadside_mounts": post_mounts(comparison.road_map, mounts),
        "signal.policy": policy,
    }
    if fence is not None:
        settings |= {"edge.upstream_m": fence.upstream_m, "edge.downstream_m": fence.downstream_m}
        settings["signal.hold_s"] = fence.own["hold_s"]
        settings["signal.phases"] = fence.settings.get("phases", "plan")
    for seed in asked.seeds:
        title = f"{comparison.name} {policy} {sight} seed={seed}"
        scenario = resolve({**asked.common_settings, **settings, "seed": seed})
        draws = policy == PREDICTIVE and seed == asked.seeds[0]
        yield PerceivedCase(title, scenario, draws)


def weights(comparison: Comparison) -> dict[str, tuple[int, float]]:
    """Returns by stage how many runs it has, and about how much work each is."""
    asked = comparison.question
    seeds, whole_s = len(asked.seeds), asked.warmup_s + asked.duration_s
    tunings = [worth_trying(tried, comparison.road_map) for tried in _TUNED.values()]
    tried = sum(map(len, tunings)) * len(TUNING_SEEDS) if asked.tuning_s else 0
    frames = asked.duration_s / asked.frame_period_s
    numbers = (
        (1, whole_s),
        (tried, asked.warmup_s + asked.tuning_s),
        (len((*BASELINES, *POLICIES)) * seeds, whole_s),
        (len(POLICIES) * len(comparison.sights) * seeds, _FRAME_WORK * frames + whole_s),
    )
    return dict(zip(STAGES, numbers, strict=True))
