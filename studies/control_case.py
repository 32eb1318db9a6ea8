"""A case of the control bench: net, demand, policy and settings, and the files of SUMO for it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from sim_host.cabinet import programme
from sim_host.city_demand import SATURATION
from sim_host.config import CabinetConfig
from sim_host.junctions import DEMAND_VPH_PER_LANE
from sim_host.networks import NETWORKS
from sim_host.setup import OWN_CONFIG, SUMO_FOLDER, build_setup
from studies.control_baselines import Tuning
from studies.control_file import NETS

OWN_PLAN = "plan"
WEBSTER = "webster"
PROGRAM = "own"
"""Id of the programs that are written for SUMO's own control, beside the net's."""
_DEFAULT_LANE_VPH = 500.0


@dataclass(frozen=True, slots=True, eq=False)
class ControlCase:
    """One run.

    Attributes:
        net: of `NETS`, a .sumocfg, or a folder with one.
        policy: what `signal.policy` may be, or a baseline: `plan` (the net's own programme) or
            one of `OWN_SETTINGS`.
        demand: factor of the net's own demand; of `NETS` alone.
        seed: SUMO's.
        upstream_m: how far before the stop bars vehicles are known and count.
        downstream_m: how far behind them they count.
        settings: of the scenario's section `signal`.
        cabinet: its section `cabinet`.
        reporting: share of the vehicles that are known; with less than all of them, the coverage of
            all lanes is unknown to policies.
        own: of a baseline, see `OWN_SETTINGS`.
        flows_vph: by lane before a stop bar, for `webster`.
        warmup_s: on the net's own plan, before the policy and all measures begin.
        junctions: ids of the signals that the policy controls; empty: all.
    """

    net: str
    policy: str
    seed: int = 1
    demand: float = 1.0
    duration_s: int = 3600
    upstream_m: float = 200.0
    downstream_m: float = 100.0
    settings: Mapping[str, Any] = field(default_factory=dict)
    cabinet: Mapping[str, Any] = field(default_factory=dict)
    reporting: float = 1.0
    own: Mapping[str, float] = field(default_factory=dict)
    flows_vph: Mapping[str, float] = field(default_factory=dict)
    warmup_s: int = 0
    junctions: tuple[str, ...] = ()

    def tuned(self, tuning: Tuning) -> ControlCase:
        """Returns the case with a tuning of its policy."""
        upstream_m, downstream_m = tuning.upstream_m, tuning.downstream_m
        return replace(
            self,
            upstream_m=self.upstream_m if upstream_m is None else upstream_m,
            downstream_m=self.downstream_m if downstream_m is None else downstream_m,
            own={**self.own, **tuning.own},
            cabinet={**self.cabinet, **tuning.cabinet},
            settings={**self.settings, **tuning.settings},
        )


def roads_of(case: ControlCase, folder: Path) -> tuple[Path, RoadMap]:
    """Returns the sumocfg of a case and its road map, with all its signals."""
    if case.net in NETS:
        traffic = _own_traffic(case)
        config = folder / SUMO_FOLDER / OWN_CONFIG
    else:
        found = [Path(case.net)]
        if found[0].suffix != ".sumocfg":
            found = sorted(found[0].glob("*.sumocfg"))
        if len(found) != 1:
            raise ConfigError(
                f"--net {case.net}: must be {', '.join(NETS)}, a .sumocfg or a folder with one"
            )
        config = found[0]
        traffic = {"sumocfg": str(config)}
    junctions = list(case.junctions) or "all"
    signal = {"policy": case.policy, "phases": "auto", **case.settings}
    setup = build_setup({"traffic": traffic, "junctions": junctions, "signal": signal}, folder)
    if case.net == "moving_peak":
        _move_peak(config.parent / "demand.rou.xml", case.duration_s)
    return config, setup.road_map


def _own_traffic(case: ControlCase) -> dict[str, Any]:
    """Returns the section `traffic` of a built-in net with its demand."""
    if case.net in NETWORKS:
        return {"network": case.net, "saturation": SATURATION * case.demand}
    sides = {"west_in": _DEFAULT_LANE_VPH, "east_in": _DEFAULT_LANE_VPH, **DEMAND_VPH_PER_LANE}
    return {"demand_vph_per_lane": {edge: vph * case.demand for edge, vph in sides.items()}}


_PEAKS = {"north_in": (0.75, 2.2), "": (0.25, 1.0)}
"""Peak of the demand, by the edge that vehicles come from, else of all: its time and height."""
_BASE, _PEAK_WIDTH = 0.6, 0.13  # demand far from a peak; its standard deviation, of the run
_SLICES = 24


def _move_peak(routes: Path, duration_s: int) -> None:
    """Makes the demand peak on the main road early in the run, and late on the side road."""
    tree = ElementTree.parse(routes)
    root = tree.getroot()
    slices: list[ElementTree.Element] = []
    for flow in root.findall("flow"):
        root.remove(flow)
        at, height = _PEAKS.get(flow.get("id", "").partition("-to-")[0], _PEAKS[""])
        per_s = float(flow.get("period", "").removeprefix("exp(").removesuffix(")"))
        for number in range(_SLICES):
            away = ((number + 0.5) / _SLICES - at) / _PEAK_WIDTH
            rate = per_s * (_BASE + height * math.exp(-(away**2) / 2))
            begin_s, end_s = (n * duration_s / _SLICES for n in (number, number + 1))
            own = {
                "id": f"{flow.get('id')}.{number}",
                "begin": f"{begin_s:g}",
                "end": f"{end_s:g}",
                "period": f"exp({rate:.9f})",
            }
            slices.append(ElementTree.Element("flow", {**flow.attrib, **own}))
    slices.sort(key=lambda one: float(one.get("begin", 0)))
    root.extend(slices)
    tree.write(routes)


def write_programs(case: ControlCase, config: Path, road_map: RoadMap, folder: Path) -> str:
    """Writes the programs of SUMO's own control; returns all additional files of the run.

    They have the plan's greens and the cabinet's times. SUMO takes their parameters from a file
    alone.
    """
    cabinet = CabinetConfig.model_validate(dict(case.cabinet))
    root = ElementTree.Element("additional")
    for one in road_map.intersections:
        try:
            intervals = programme(one.signal, cabinet)
        except ConfigError:
            continue  # with one green only there is nothing to decide
        logic = ElementTree.SubElement(
            root, "tlLogic", id=one.signal.tls, type=case.policy, programID=PROGRAM, offset="0"
        )
        for name, value in case.own.items():
            ElementTree.SubElement(logic, "param", key=name, value=f"{value:g}")
        for i in intervals:
            least, most = f"{i.least_s:g}", f"{i.most_s:g}"
            ElementTree.SubElement(
                logic, "phase", state=i.state, duration=least, minDur=least, maxDur=most
            )
    path = folder / "programs.add.xml"
    ElementTree.ElementTree(root).write(path)
    found = ElementTree.parse(config).getroot().iter("additional-files")
    given = [name for one in found for name in one.get("value", "").split(",") if name.strip()]
    return ",".join([*(str(config.parent / name.strip()) for name in given), str(path)])
