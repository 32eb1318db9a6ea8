"""A run of SUMO alone with a policy and a cabinet at each signal, on perfect positions."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any
from xml.etree import ElementTree

import numpy as np

from protocol.approaches import Approaches, bar_starts_m
from protocol.errors import ConfigError
from protocol.messages import LaneCounts
from protocol.roadmap import RoadMap, Signal
from signal_controller.config import SignalConfig
from signal_controller.observation import CabinetTimes, LaneVehicles, Observation, SignalSite
from signal_controller.policies import HeldGreens, Predictive, SignalPolicy, policy_of
from sim_host.cabinet import SignalCabinet
from sim_host.config import CabinetConfig
from sim_host.sumo import load_libsumo
from studies.approach_log import ApproachLog, VehicleSample
from studies.bench import JsonRow
from studies.control_baselines import (
    PRESSURES,
    SUMO_TYPES,
    WeightedPressure,
    webster,
)
from studies.control_case import OWN_PLAN, PROGRAM, WEBSTER, ControlCase, roads_of, write_programs

STEP_S = 0.1
_STEPS_A_SECOND = round(1 / STEP_S)
_STATIONARY_MPS = 0.5
_SETTLED_S = 300  # from when on estimates are scored
_QUEUED_MPS = 1.0  # one that was slower before the stop bar queues until it has passed it


@dataclass(frozen=True, slots=True)
class ControlRow(JsonRow):
    """Results of a run; times in s, of all vehicles. `waited_s` is the longest wait in one go.

    `reporting` is the share of the vehicles that cpnet's policies knew of (unused by fixed plans
    and SUMO's own control); `stops` and `co2_g` (by SUMO's emission model) are means of the
    vehicles.

    Of lanes whose queues a policy had to estimate, `queue_error` is the mean absolute error of
    their medians in vehicles, `queue_inside` how often the interval that is to hold it by 90 % did.
    """

    net: str
    policy: str
    demand: float
    reporting: float
    seed: int
    vehicles: int
    arrived: int
    delay_s: float
    delay_p95_s: float
    waited_s: float
    stops: float
    co2_g: float
    decide_p50_ms: float
    decide_p99_ms: float
    queue_error: float | None = None
    queue_inside: float | None = None


class ControlRun:
    """One run of SUMO with a policy at each signal."""

    def __init__(self, case: ControlCase, folder: Path) -> None:
        self._case = case
        self._folder = folder
        self._config, self._road_map = roads_of(case, folder)
        self._sumo = load_libsumo()
        self._decide_ns: list[int] = []
        self._queues: list[tuple[float, bool]] = []
        self.passed: Counter[str] = Counter()
        self.log = ApproachLog(self._road_map, 1.0)
        self._lane_of: dict[str, str] = {}
        self._measured_from_s = 0.0

    def row(self) -> ControlRow:
        """Runs it."""
        trips = self._folder / "trips.xml"
        options = {
            "configuration-file": str(self._config),
            "step-length": f"{STEP_S:g}",
            "seed": str(self._case.seed),
            "random": "false",
            "no-step-log": "true",
            "no-warnings": "true",
            "duration-log.disable": "true",
            "xml-validation": "never",
            "time-to-teleport": "-1",
            "tripinfo-output": str(trips),
            "tripinfo-output.write-unfinished": "true",
            "tripinfo-output.write-undeparted": "true",
            "device.emissions.probability": "1",
        }
        if self._case.policy in SUMO_TYPES:
            options["additional-files"] = write_programs(
                self._case, self._config, self._road_map, self._folder
            )
        command = ["sumo", *(word for k, v in options.items() for word in (f"--{k}", v))]
        try:
            self._sumo.start(command)
        except (self._sumo.TraCIException, self._sumo.FatalTraCIError) as error:
            raise ConfigError(f"SUMO refuses {self._config}: {error}") from None
        try:
            self._drive(_controllers(self._case, self._road_map))
        finally:
            self._sumo.close()
        delays, arrived = delays_s(trips, self._measured_from_s)
        stops, co2_g = stops_and_co2(trips, self._measured_from_s)
        decide_ms = np.array(self._decide_ns or [0]) / 1e6
        return ControlRow(
            net=Path(self._case.net).name,
            policy=self._case.policy,
            demand=self._case.demand,
            reporting=self._case.reporting,
            seed=self._case.seed,
            vehicles=len(delays),
            arrived=arrived,
            delay_s=mean(delays) if delays else 0.0,
            delay_p95_s=float(np.quantile(delays, 0.95)) if delays else 0.0,
            waited_s=self.log.waited_s,
            stops=stops,
            co2_g=co2_g,
            decide_p50_ms=float(np.quantile(decide_ms, 0.5)),
            decide_p99_ms=float(np.quantile(decide_ms, 0.99)),
            queue_error=mean(off for off, _ in self._queues) if self._queues else None,
            queue_inside=mean(is_in for _, is_in in self._queues) if self._queues else None,
        )

    def _drive(self, controllers: list[_Controller]) -> None:
        begin_s, warmup_s = self._sumo.simulation.getTime(), self._case.warmup_s
        self._measured_from_s = begin_s + warmup_s
        truth = TruePositions(self._road_map, self._case)
        shown: dict[str, str] = {}
        on_plan = self._on_plan() if warmup_s and self._case.policy in SUMO_TYPES else []
        for step in range((warmup_s + self._case.duration_s) * _STEPS_A_SECOND):
            now_ns = round((begin_s + step * STEP_S) * 1e9)
            second, rest = divmod(step, _STEPS_A_SECOND)
            if second >= warmup_s:
                on_plan = [signal for signal in on_plan if not self._take_over(signal)]
            if rest == 0 and second >= warmup_s:
                truth.read(self._sumo)
                self._note_passages(truth.all)
                self.log.note(now_ns / 1e9 - self._measured_from_s, self._vehicles())
                for one in controllers:
                    self._decide_ns.append(one.decide(step, now_ns, truth))
                    if second - warmup_s >= _SETTLED_S:
                        self._queues += one.queue_errors(truth)
            for one in controllers:
                state = one.cabinet.advance(now_ns)
                if shown.get(one.tls) != state:
                    self._sumo.trafficlight.setRedYellowGreenState(one.tls, state)
                    shown[one.tls] = state
            self._step(now_ns / 1e9)

    def _step(self, time_s: float) -> None:
        """Runs one SUMO step.

        Raises:
            ConfigError: SUMO gives up, as on a vehicle without a route. Its own errors would not
                pass from a process to another.
        """
        try:
            self._sumo.simulationStep()
        except (self._sumo.TraCIException, self._sumo.FatalTraCIError) as error:
            raise ConfigError(f"SUMO gave up at {time_s:g} s on {self._config}: {error}") from None

    def _on_plan(self) -> list[Signal]:
        """Sets the signals that SUMO is to control on the net's plan; returns them."""
        lights, found = self._sumo.trafficlight, []
        for one in self._road_map.intersections:
            known = [logic.programID for logic in lights.getAllProgramLogics(one.signal.tls)]
            if PROGRAM in known:
                lights.setProgram(one.signal.tls, next(n for n in known if n != PROGRAM))
                found.append(one.signal)
        return found

    def _take_over(self, signal: Signal) -> bool:
        """Leaves a signal to SUMO's own control once it shows a green, from which SUMO continues.

        At any other moment the program would begin with another state, without yellow between.
        """
        lights = self._sumo.trafficlight
        state = lights.getRedYellowGreenState(signal.tls)
        if state not in signal.planned_greens:
            return False
        lights.setProgram(signal.tls, PROGRAM)
        for logic in lights.getAllProgramLogics(signal.tls):
            if logic.programID == PROGRAM:
                states = [phase.state for phase in logic.phases]
                lights.setPhase(signal.tls, states.index(state))
        return True

    def _vehicles(self) -> Iterator[VehicleSample]:
        vehicle = self._sumo.vehicle
        for name in vehicle.getIDList():
            lane, along_m = vehicle.getLaneID(name), vehicle.getLanePosition(name)
            yield VehicleSample(name, lane, along_m, vehicle.getSpeed(name))

    def _note_passages(self, vehicles: LaneVehicles) -> None:
        incoming = set(self._road_map.incoming)
        for name, lane in zip(vehicles.ids, vehicles.lanes, strict=True):
            before = self._lane_of.get(name, lane)
            if before in incoming and lane not in incoming:
                self.passed[before] += 1
            self._lane_of[name] = lane


class _Controller:
    """A policy and its cabinet."""

    def __init__(self, policy: SignalPolicy, site: SignalSite, case: ControlCase) -> None:
        cabinet = CabinetConfig.model_validate(dict(case.cabinet))
        self.tls = site.signal.tls
        self.cabinet = SignalCabinet(site.signal, cabinet)
        self._policy = policy
        self._case = case
        self._approaches = Approaches(site.road_map, site.road_map.by_tls[self.tls])

    def decide(self, frame: int, now_ns: int, truth: TruePositions) -> int:
        """Requests the policy's decision; returns the time that it took, in ns."""
        self.cabinet.advance(now_ns)
        shown = self.cabinet.spat(frame, now_ns)
        counts = self._counts(frame, now_ns, truth)
        start_ns = time.monotonic_ns()
        decision = self._policy.decide(Observation(counts, shown, truth.vehicles))
        taken_ns = time.monotonic_ns() - start_ns
        self.cabinet.request(decision.request(self.tls, frame, now_ns), now_ns)
        return taken_ns

    def queue_errors(self, truth: TruePositions) -> list[tuple[float, bool]]:
        """Returns the error of each estimated queue, and whether its interval is right."""
        queues = self._policy.planner.queues if isinstance(self._policy, Predictive) else None
        if queues is None or queues.is_seen.all():
            return []
        incoming = self._approaches.intersection.incoming
        standing = dict.fromkeys(incoming, 0)
        for lane, name, distance_m in zip(
            truth.all.lanes, truth.all.ids, truth.all.distances_m.tolist(), strict=True
        ):
            side = self._approaches.upstream.get(lane)
            if side is not None and distance_m <= self._case.upstream_m:
                standing[side.counts_for] += name in truth.queued
        found = []  # type: list[tuple[float, bool]]
        for index in np.flatnonzero(~queues.is_seen).tolist():
            queue, number = queues.queue(index), standing[incoming[index]]
            found.append((abs(queue.median - number), queue.low <= number <= queue.high))
        return found

    def _counts(self, frame: int, now_ns: int, truth: TruePositions) -> LaneCounts:
        around, case = self._approaches, self._case
        incoming, outgoing = around.intersection.incoming, around.intersection.outgoing
        before, waiting = dict.fromkeys(incoming, 0), dict.fromkeys(incoming, 0)
        behind, standing = dict.fromkeys(outgoing, 0), dict.fromkeys(outgoing, 0)
        for lane, along_m, speed_mps in truth.rows:
            reach = around.upstream.get(lane)
            if reach and reach.start_m - along_m <= case.upstream_m:
                before[reach.counts_for] += 1
                waiting[reach.counts_for] += speed_mps < _STATIONARY_MPS
            reach = around.downstream.get(lane)
            if reach and along_m - reach.start_m <= case.downstream_m:
                behind[reach.counts_for] += 1
                standing[reach.counts_for] += speed_mps < _STATIONARY_MPS
        return LaneCounts(
            frame=frame,
            sim_time_ns=now_ns,
            tls=self.tls,
            agents=[],
            complete=True,
            upstream=before,
            downstream=behind,
            stationary_upstream=waiting,
            stationary_downstream=standing,
            coverage_upstream=dict.fromkeys(incoming if case.reporting == 1 else [], 1.0),
            coverage_from_bar=dict.fromkeys(incoming if case.reporting == 1 else [], 1.0),
            coverage_downstream=dict.fromkeys(outgoing if case.reporting == 1 else [], 1.0),
        )


class TruePositions:
    """True positions of the vehicles that policies may know of, read once a decision.

    `rows` are lane, metres along it and speed in m/s, in the order of `vehicles`: those that are
    known of `all`. `queued` are the names of those that have stood before a stop bar.
    """

    def __init__(self, road_map: RoadMap, case: ControlCase) -> None:
        around = [Approaches(road_map, one) for one in road_map.intersections]
        self._starts_m = bar_starts_m(around)
        self._behind_m: dict[str, float] = {}
        for lane, reach in (item for one in around for item in one.downstream.items()):
            self._behind_m[lane] = max(reach.start_m, self._behind_m.get(lane, -math.inf))
        self._measured = {lane.id: lane.measured_share for lane in road_map.lanes}
        self._reach_m = case.upstream_m, case.downstream_m
        self._reporting = case.reporting
        self._draw = np.random.default_rng(case.seed)
        self._reports: dict[str, bool] = {}
        self.queued: set[str] = set()
        self.rows: list[tuple[str, float, float]] = []
        self.vehicles = LaneVehicles([], np.zeros(0), np.zeros(0), np.zeros(0), [])
        self.all = self.vehicles

    def _is_known(self, lane: str, along_m: float) -> bool:
        """Whether a place is as near before a stop bar, or behind one, as vehicles are known.

        A lane between two signals may be behind the one and before the other.
        """
        before_m = self._starts_m[lane] - along_m
        behind_m = along_m - self._behind_m.get(lane, -math.inf)
        upstream_m, downstream_m = self._reach_m
        return -downstream_m <= before_m <= upstream_m or behind_m <= downstream_m

    def read(self, sumo: Any) -> None:  # noqa: ANN401 - libsumo has no types
        """Reads them from SUMO."""
        vehicle, ids, rows, distances_m, lengths_m = sumo.vehicle, [], [], [], []
        for name in sorted(vehicle.getIDList()):
            lane = vehicle.getLaneID(name)
            start_m = self._starts_m.get(lane)
            if start_m is None:
                continue
            along_m = vehicle.getLanePosition(name) * self._measured.get(lane, 1.0)
            if not self._is_known(lane, along_m):
                continue
            ids.append(name)
            rows.append((lane, along_m, vehicle.getSpeed(name)))
            distances_m.append(start_m - along_m)
            lengths_m.append(vehicle.getLength(name))
        self.all = LaneVehicles(
            lanes=[lane for lane, _, _ in rows],
            distances_m=np.array(distances_m),
            speeds_mps=np.array([speed_mps for _, _, speed_mps in rows]),
            lengths_m=np.array(lengths_m),
            ids=ids,
        )
        slow = self.all.speeds_mps < _QUEUED_MPS
        self.queued |= {name for name, stands in zip(ids, slow.tolist(), strict=True) if stands}
        for name in ids:
            if name not in self._reports:
                self._reports[name] = bool(self._draw.random() < self._reporting)
        known = [index for index, name in enumerate(ids) if self._reports[name]]
        self.rows = [rows[index] for index in known]
        self.vehicles = self.all.take(np.array(known, np.int64))


def _controllers(case: ControlCase, road_map: RoadMap) -> list[_Controller]:
    """Returns the controllers of the signals; none where SUMO's own programs control."""
    if case.policy == OWN_PLAN or case.policy in SUMO_TYPES:
        return []
    cabinet = CabinetConfig.model_validate(dict(case.cabinet))
    times = CabinetTimes.of(cabinet.model_dump())
    sites = [
        SignalSite(one.signal, road_map, case.upstream_m, times) for one in road_map.intersections
    ]
    return [_Controller(_policy(case, site), site, case) for site in sites]


def _policy(case: ControlCase, site: SignalSite) -> SignalPolicy:
    kind = PRESSURES.get(case.policy)
    if case.policy == WEBSTER:
        flows_vph = {lane: case.flows_vph.get(lane, 0.0) for lane in site.lanes}
        return webster(site, flows_vph, case.own.get("cycle_factor", 1.0))
    if kind is None:
        return policy_of(
            SignalConfig.model_validate({"policy": case.policy, **case.settings}), site
        )
    hold_s = case.own.get("hold_s", 0.0)
    if kind in ("vehicles", "queued"):
        settings = {"policy": "max_pressure", "weight": kind, "hold_s": hold_s, **case.settings}
        return policy_of(SignalConfig.model_validate(settings), site)
    return HeldGreens(WeightedPressure(site, kind, case.downstream_m), hold_s)


def delays_s(trips: Path, since_s: float = -math.inf) -> tuple[list[float], int]:
    """Returns each vehicle's time loss plus departure delay in s, and how many arrived.

    Args:
        trips: SUMO's tripinfo, with those under way and those that never entered.
        since_s: vehicles that arrived before do not count.
    """
    delays, arrived = [], 0
    for trip in _trips(trips, since_s):
        delays.append(float(trip.get("timeLoss", 0)) + float(trip.get("departDelay", 0)))
        arrived += float(trip.get("arrival", -1)) >= 0
    return delays, arrived


def stops_and_co2(trips: Path, since_s: float) -> tuple[float, float]:
    """Returns how often a vehicle stopped and its CO2 in g, means of those that `delays_s` takes.

    Of those that never entered both are 0.
    """
    stops, co2_g = [], []
    for trip in _trips(trips, since_s):
        emissions = trip.find("emissions")
        stops.append(int(trip.get("waitingCount", 0)))
        co2_g.append(0.0 if emissions is None else float(emissions.get("CO2_abs", 0)) / 1000)
    return (mean(stops), mean(co2_g)) if stops else (0.0, 0.0)


def _trips(trips: Path, since_s: float) -> Iterator[ElementTree.Element]:
    for _, element in ElementTree.iterparse(trips):
        if element.tag == "tripinfo":
            arrival_s = float(element.get("arrival", -1))
            if arrival_s < 0 or arrival_s >= since_s:
                yield element
            element.clear()
