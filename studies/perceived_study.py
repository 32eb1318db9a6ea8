"""Controls of `cpnet study control` with perception in the loop, on the traffic of all others.

A file's `perceived` names each with keys of the scenario. A post stands at each signal and no CAV
drives, unless these say otherwise; frames are as far apart as decisions are on SUMO alone.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from studies.control_case import OWN_PLAN, ControlCase, roads_of
from studies.control_file import ControlStudy
from studies.control_study import CaseStore, PolicyResult, Report, groups_of_study
from studies.perceived_case import PerceivedCase, run_perceived
from studies.post_places import post_mounts
from studies.sumo_config import PAIRED_SETTINGS, SAME_FOR_ALL
from studies.sweep.cells import Resolve

FRAME_PERIOD_S = 1.0
_SAME = {
    *SAME_FOR_ALL,
    *("seed", "name", "frame_period_s", "duration_s", "junctions"),
    *("traffic.warmup_s", "traffic.sumocfg", "traffic.net", "traffic.network"),
}
"""Keys that no control may set."""


def perceived_cases(study: ControlStudy, folder: Path, resolve: Resolve) -> list[PerceivedCase]:
    """Returns the runs: of each net and demand each control, seed by seed.

    The files of SUMO for nets that are built in are written into the folder.

    Raises:
        ConfigError: a net is invalid, a control sets a key that it may not, or the folder is not
            usable.
    """
    found = []
    for group in groups_of_study(study) if study.perceived else ():
        own = folder / "nets" / re.sub(r"[^A-Za-z0-9.]+", "-", group.title)
        try:
            own.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out {folder}: {error}") from None
        case = ControlCase(
            group.net,
            OWN_PLAN,
            demand=group.demand,
            duration_s=study.duration_s,
            junctions=tuple(study.junctions),
        )
        config, road_map = roads_of(case, own)
        for title, keys in study.perceived.items():
            settings = {**_common(study, config, road_map), **_own(study, title, keys)}
            for seed in study.seeds:
                name = f"{group.title} {title} seed={seed}"
                found.append(PerceivedCase(name, resolve({**settings, "seed": seed}), draws=False))
    return found


def run_perceived_controls(
    study: ControlStudy,
    cases: list[PerceivedCase],
    folder: Path,
    processes: int,
    report: Report,
) -> list[PolicyResult]:
    """Runs the missing runs of `perceived_cases`.

    Raises:
        ConfigError: a scenario cannot be run.
    """
    rows = iter(CaseStore(folder).run(run_perceived, cases, processes, report) if cases else ())
    cells = [(group, title) for group in groups_of_study(study) for title in study.perceived]
    return [
        PolicyResult(title, [next(rows) for _ in study.seeds], group, None)
        for group, title in cells
    ]


def _common(study: ControlStudy, config: Path, road_map: RoadMap) -> dict[str, Any]:
    signals = sorted(road_map.by_tls)
    return {
        **PAIRED_SETTINGS,
        "name": study.name,
        "frame_period_s": FRAME_PERIOD_S,
        "duration_s": study.duration_s,
        "traffic.warmup_s": study.warmup_s,
        "traffic.sumocfg": str(config.resolve()),
        "junctions": signals,
        "roadside_mounts": post_mounts(road_map, signals),
        "traffic.cav_rate": 0,
        "record.snapshot_period_s": 0,
        **{f"cabinet.{key}": value for key, value in study.cabinet.items()},
    }


def _own(study: ControlStudy, title: str, keys: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns the keys of a control.

    Raises:
        ConfigError: one of them is the same for all controls.
    """
    for key in keys:
        if any(f"{key}.".startswith(f"{one}.") for one in _SAME):
            raise ConfigError(
                f"study {study.name}: perceived.{title}: {key} is the same for all controls"
            )
    return keys
