"""Traffic: the world that SUMO simulates, or recorded traffic, and its messages.

One SUMO world per process, for libsumo keeps its state globally.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from protocol.errors import ConfigError
from protocol.geometry import Floats
from protocol.messages import PEDESTRIAN, Equipment, Setup, Trip, Truth
from sensing.recorded_scans import Recording
from sim_host.cabinet import Interval
from sim_host.journeys import Journey, Journeys, safe_id
from sim_host.lateral import LaneHeadings, LateralPositions
from sim_host.pedestrians import PEDESTRIAN_TYPE, Pedestrians
from sim_host.setup import config_file, traffic_config
from sim_host.sumo import load_libsumo

ACTUATED = "actuated"
_ACTUATED_TYPE = 3  # of SUMO's kinds of program


class Ground(Protocol):
    """Poses of bodies on the ground."""

    def body_poses(self, x: Floats, y: Floats, yaw: Floats, level_m: Floats) -> Floats:
        """Returns poses (N, 6) of footprint centres at x, y (N,) in m, heading yaw (N,) in rad.

        `level_m` (N,) is the height of the lane, which decides between roads above one another.
        """


@dataclass(frozen=True, slots=True, eq=False)
class TrafficState:
    """The bodies around the signals, vehicles first. Poses are of footprint centres."""

    ids: list[str]
    types: list[str]
    lanes: list[str]
    poses: Floats
    speeds_mps: npt.NDArray[np.float32]
    lane_positions_m: npt.NDArray[np.float32]
    equipment: npt.NDArray[np.uint8]

    @classmethod
    def of_truth(cls, truth: Truth) -> TrafficState:
        """Returns the vehicles of a recorded frame."""
        return cls(
            ids=truth.ids,
            types=truth.types,
            lanes=truth.lanes,
            poses=truth.poses,
            speeds_mps=truth.speeds_mps,
            lane_positions_m=truth.lane_positions_m,
            equipment=truth.equipment,
        )

    def with_parked(self, setup: Setup) -> TrafficState:
        """Returns the vehicles and the parked cars of a setup."""
        speeds_mps = np.zeros(len(setup.parked_types))
        return self.and_also(
            TrafficState.off_the_lanes(
                setup.parked_ids, setup.parked_types, setup.parked_poses, speeds_mps
            )
        )

    @classmethod
    def off_the_lanes(
        cls, ids: list[str], types: list[str], poses: Floats, speeds_mps: Floats
    ) -> TrafficState:
        """Returns bodies (N,) that are on no lane and carry nothing."""
        return cls(
            ids=ids,
            types=types,
            lanes=[""] * len(ids),
            poses=poses,
            speeds_mps=np.asarray(speeds_mps, np.float32),
            lane_positions_m=np.zeros(len(ids), np.float32),
            equipment=np.zeros(len(ids), np.uint8),
        )

    def and_also(self, others: TrafficState) -> TrafficState:
        """Returns these bodies and, after them, others."""
        if not others.ids:
            return self
        return TrafficState(
            ids=self.ids + others.ids,
            types=self.types + others.types,
            lanes=self.lanes + others.lanes,
            poses=np.concatenate([self.poses, others.poses]),
            speeds_mps=np.append(self.speeds_mps, others.speeds_mps),
            lane_positions_m=np.append(self.lane_positions_m, others.lane_positions_m),
            equipment=np.append(self.equipment, others.equipment),
        )


@dataclass(frozen=True, slots=True)
class TrafficCounts:
    """Vehicles since SUMO's start, including the warm-up and those outside the radius."""

    inserted: int = 0
    finished: int = 0
    teleported: int = 0


class World:
    """The traffic that SUMO simulates. `start` must come first and `close` last."""

    def __init__(self, setup: Setup, run_dir: Path, ground: Ground) -> None:
        self._traffic = traffic_config(setup.scenario)
        self._config = config_file(self._traffic, run_dir)
        self._ground = ground
        self._centres = np.array([one.centre for one in setup.road_map.intersections])
        self._setup = setup
        self._shown: dict[str, str] = {}
        self._widths_m: dict[str, float] = {}
        self._radios: dict[str, str] = {}  # SUMO's ids of the agents within the radius
        self._sumo: Any = None
        self.counts = TrafficCounts()
        self.time_ns = 0

    def start(self, seed: int) -> None:
        """Loads SUMO with the net and the demand; the same seed gives the same traffic.

        Raises:
            ConfigError: SUMO's files are missing or SUMO refuses them.
        """
        if not self._config.is_file():
            raise ConfigError(
                f"SUMO configuration {self._config} is missing: build the setup on the machine "
                "that runs the role sim"
            )
        self._sumo = load_libsumo()
        self._journeys = Journeys(self._setup, seed, self._sumo)
        self._lateral = LateralPositions(self._traffic.lateral, seed)
        self._headings = LaneHeadings(self._sumo)
        self._pedestrians = Pedestrians(self._setup, self._traffic, seed, self._sumo)
        options = {
            "configuration-file": str(self._config),
            "step-length": f"{self._traffic.step_s:g}",
            "seed": str(seed % 2**31),
            "random": "false",
            "no-step-log": "true",
            "duration-log.disable": "true",
            "xml-validation": "never",
        }
        lane_change_s = self._traffic.lateral.lane_change_s
        if lane_change_s:
            options["lanechange.duration"] = f"{lane_change_s:g}"
        command = ["sumo"] + [word for k, v in options.items() for word in (f"--{k}", v)]
        try:
            self._sumo.start(command)
        except self._errors() as error:
            raise ConfigError(f"SUMO refuses {self._config}: {error}") from None
        self._read_clock()

    def step(self) -> None:
        """Runs one SUMO step and counts vehicles that departed, arrived and were teleported.

        Raises:
            ConfigError: SUMO gives up, as on a route file with an invalid route.
        """
        simulation = self._sumo.simulation
        try:
            self._sumo.simulationStep()
        except self._errors() as error:
            raise ConfigError(
                f"SUMO gave up at {self.time_ns / 1e9:g} s on {self._config}: {error}"
            ) from None
        self._read_clock()
        arrived = simulation.getArrivedIDList()
        jumped = simulation.getStartingTeleportIDList()
        self.counts = replace(
            self.counts,
            inserted=self.counts.inserted + simulation.getDepartedNumber(),
            finished=self.counts.finished + len(arrived),
            teleported=self.counts.teleported + len(jumped),
        )
        for name in jumped:
            self._journeys.note_teleport(name)
        for name in sorted(arrived):
            self._journeys.end(name, self.time_ns / 1e9)
            self._radios.pop(safe_id(name), None)
        self._journeys.note_step()
        self._pedestrians.step(self.time_ns / 1e9)

    def bodies(self) -> TrafficState:
        """Returns where every vehicle within the radius is now, and all people after them."""
        return self._vehicles().and_also(self._people())

    def _vehicles(self) -> TrafficState:
        vehicle = self._sumo.vehicle
        names = sorted(vehicle.getIDList())
        fronts = np.array([vehicle.getPosition3D(name) for name in names]).reshape(-1, 3)
        near = _nearest_m(fronts, self._centres) <= self._traffic.radius_m
        names = [name for name, is_near in zip(names, near, strict=True) if is_near]
        journeys = self._journeys.within_radius(names)
        self._radios = {
            journey.name: name
            for journey, name in zip(journeys, names, strict=True)
            if journey.equipment is not Equipment.NONE
        }
        lanes = [vehicle.getLaneID(name) for name in names]
        yaw = np.radians(90.0 - np.array([vehicle.getAngle(name) for name in names]))
        half = np.array([journey.type.length_m / 2 for journey in journeys])
        if self._traffic.lateral.lane_change_s:
            yaw = self._headings.yaws_rad(names, lanes, 2 * half, yaw)
        x, y = fronts[near, :2].T - half * np.array([np.cos(yaw), np.sin(yaw)])
        if not self._lateral.all_centred:
            x, y, yaw = self._beside_the_middle(names, journeys, lanes, (x, y, yaw))
        return TrafficState(
            ids=[journey.name for journey in journeys],
            types=[journey.type.name for journey in journeys],
            lanes=lanes,
            poses=self._ground.body_poses(x, y, yaw, fronts[near, 2]),
            speeds_mps=np.array([vehicle.getSpeed(name) for name in names], np.float32),
            lane_positions_m=np.array(
                [vehicle.getLanePosition(name) for name in names], np.float32
            ),
            equipment=np.array([journey.equipment for journey in journeys], np.uint8),
        )

    def _people(self) -> TrafficState:
        """Returns the pedestrians of this model, and SUMO's own persons within the radius."""
        own, person = self._pedestrians.people(), self._sumo.person
        names = [name for name in sorted(person.getIDList()) if not person.getVehicle(name)]
        places = np.array([person.getPosition3D(name) for name in names]).reshape(-1, 3)
        near = _nearest_m(places, self._centres) <= self._traffic.radius_m
        names = [name for name, is_near in zip(names, near, strict=True) if is_near]
        yaw = np.radians(90.0 - np.array([person.getAngle(name) for name in names]))
        plane = np.concatenate([own.plane, np.column_stack([places[near, :2], yaw])])
        level_m = np.concatenate([self._nearest_level_m(own.plane), places[near, 2]])
        x, y, yaw = plane.T
        poses = self._ground.body_poses(x, y, yaw, level_m)
        poses[:, 3:5] = 0.0  # people stand upright
        poses[: len(own.ids), 2] += own.above_m
        walking_mps = [person.getSpeed(name) for name in names]
        types = [self._journeys.type_of(person.getTypeID(name)).name for name in names]
        return TrafficState.off_the_lanes(
            own.ids + [f"{PEDESTRIAN}sumo.{safe_id(name)}" for name in names],
            [PEDESTRIAN_TYPE] * len(own.ids) + types,
            poses,
            np.append(own.speeds_mps, walking_mps),
        )

    def _nearest_level_m(self, places: Floats) -> Floats:
        """Returns how high the intersections lie that are nearest to places (N, 2 or more)."""
        away_m = np.linalg.norm(places[:, None, :2] - self._centres[:, :2], axis=2)
        return np.asarray(self._centres[away_m.argmin(axis=1), 2])

    def _beside_the_middle(
        self,
        names: list[str],
        journeys: list[Journey],
        lanes: list[str],
        plane: tuple[Floats, Floats, Floats],
    ) -> tuple[Floats, Floats, Floats]:
        """Returns x, y in m and yaw in rad of vehicles (N,), which SUMO has in the middle."""
        x, y, yaw = plane
        vehicle, lane = self._sumo.vehicle, self._sumo.lane
        for one in {*lanes} - self._widths_m.keys():
            self._widths_m[one] = lane.getWidth(one)
        offset_m, slope_rad = self._lateral.offsets_m(
            names,
            [journey.type for journey in journeys],
            np.array([vehicle.getDistance(name) for name in names]),
            np.array([self._widths_m[one] for one in lanes]),
        )
        return x - offset_m * np.sin(yaw), y + offset_m * np.cos(yaw), yaw + slope_rad

    def run_actuated(
        self, tls: str, intervals: Sequence[Interval], parameters: Mapping[str, str]
    ) -> None:
        """Leaves a signal to SUMO from now on: its own detectors choose how long greens last.

        Args:
            tls: the signal.
            intervals: of the programme, in its order.
            parameters: of SUMO's actuated control, by SUMO's names.
        """
        lights = self._sumo.trafficlight
        phases = [lights.Phase(i.least_s, i.state, i.least_s, i.most_s) for i in intervals]
        logic = lights.Logic(ACTUATED, _ACTUATED_TYPE, 0, phases)
        logic.subParameter = dict(parameters)  # libsumo ignores it as an argument
        lights.setProgramLogic(tls, logic)
        lights.setProgram(tls, ACTUATED)

    def shown(self, tls: str) -> str:
        """Returns what a signal shows; to set that again does not take it from SUMO's control."""
        self._shown[tls] = str(self._sumo.trafficlight.getRedYellowGreenState(tls))
        return self._shown[tls]

    def set_signal(self, tls: str, state: str) -> None:
        """Shows a state at a signal, one character per link."""
        if state != self._shown.get(tls):
            self._sumo.trafficlight.setRedYellowGreenState(tls, state)
            self._shown[tls] = state

    def signals_ahead(self, agent: str) -> set[str] | None:
        """Returns the signals on an agent's route; None if no such agent is within the radius."""
        name = self._radios.get(agent)
        return None if name is None else {one[0] for one in self._sumo.vehicle.getNextTLS(name)}

    def set_speed(self, agent: str, speed_mps: float | None) -> None:
        """Lets an agent drive at a speed from now on, as far as SUMO's rules of driving let it.

        It keeps its distance, stops at red and yields, and is never faster than its driver would
        be. None lets it drive freely.
        """
        vehicle, name = self._sumo.vehicle, self._radios[agent]
        most_mps = vehicle.getAllowedSpeed(name)
        vehicle.setSpeed(name, -1 if speed_mps is None else min(speed_mps, most_mps))

    def take_trips(self) -> list[Trip]:
        """Returns the journeys that ended since the last call."""
        return self._journeys.take_ended()

    def unfinished_trips(self) -> list[Trip]:
        """Returns the journeys that are still under way, sorted by vehicle."""
        return self._journeys.unfinished()

    def waiting(self) -> int:
        """Returns how many vehicles cannot enter the net for lack of room."""
        return len(self._sumo.simulation.getPendingVehicles())

    def close(self) -> None:
        """Ends SUMO, if it was started."""
        if self._sumo is not None:
            self._sumo.close()
            self._sumo = None

    def _read_clock(self) -> None:
        self.time_ns = round(self._sumo.simulation.getTime() * 1000) * 1_000_000

    def _errors(self) -> tuple[type[Exception], ...]:
        module: ModuleType = self._sumo
        return module.TraCIException, module.FatalTraCIError


def _nearest_m(places: Floats, centres: Floats) -> Floats:
    """Returns the distance in the plane of each place (N, 2 or 3) to the nearest centre (C, 3)."""
    result = np.full(len(places), np.inf)
    for centre in centres:
        np.minimum(result, np.linalg.norm(places[:, :2] - centre[:2], axis=1), out=result)
    return result


def truth_of(frame: int, sim_time_ns: int, bodies: TrafficState) -> Truth:
    """Returns the truth of a frame: the bodies' poses, with lanes and places along them."""
    return Truth(
        frame=frame,
        sim_time_ns=sim_time_ns,
        ids=bodies.ids,
        types=bodies.types,
        lanes=bodies.lanes,
        poses=bodies.poses,
        speeds_mps=bodies.speeds_mps,
        lane_positions_m=bodies.lane_positions_m,
        equipment=bodies.equipment,
    )


class Traffic(Protocol):
    """Interface of traffic, simulated or recorded; see `World`."""

    time_ns: int
    counts: TrafficCounts

    def step(self) -> None:
        """Goes on by one step."""

    def bodies(self) -> TrafficState:
        """Returns where every vehicle within the radius is."""

    def set_signal(self, tls: str, state: str) -> None:
        """Shows a state at a signal."""

    def take_trips(self) -> list[Trip]:
        """Returns the journeys that ended since the last call."""

    def unfinished_trips(self) -> list[Trip]:
        """Returns the journeys still under way."""

    def waiting(self) -> int:
        """Returns how many vehicles cannot enter for lack of room."""

    def close(self) -> None:
        """Ends the world."""


class RecordedWorld:
    """Recorded traffic: one recorded frame a step; it does not follow the signal."""

    def __init__(self, recording: Recording, step_ns: int) -> None:
        self._recording = recording
        self._step_ns = step_ns
        self._frame = 0
        self.time_ns = 0
        self.counts = TrafficCounts(inserted=len(recording.truths[0].ids))

    def step(self) -> None:
        """Goes on to the next frame."""
        self._frame += 1
        self.time_ns += self._step_ns

    def bodies(self) -> TrafficState:
        """Returns where every vehicle was."""
        place = self._recording.place(self._frame)
        return TrafficState.of_truth(self._recording.truths[place])

    def set_signal(self, tls: str, state: str) -> None:
        """Does nothing: recorded traffic does not follow the signal."""

    def take_trips(self) -> list[Trip]:
        """Returns nothing: no vehicle arrives."""
        return []

    def unfinished_trips(self) -> list[Trip]:
        """Returns nothing: journeys were not recorded."""
        return []

    def waiting(self) -> int:
        """Returns 0: no vehicle enters."""
        return 0

    def close(self) -> None:
        """Holds nothing of its own."""


def sample_traffic(
    setup: Setup, run_dir: Path, ground: Ground, seed: int, steps: Sequence[int]
) -> list[TrafficState]:
    """Returns the traffic on the fixed plan after each of these numbers of SUMO steps, ascending.

    One such world at a time and process: libsumo keeps its state globally.

    Raises:
        ConfigError: SUMO refuses its files or gives up.
    """
    world = World(setup, run_dir, ground)
    moments = []
    done = 0
    try:
        world.start(seed)
        for wanted in steps:
            for _ in range(wanted - done):
                world.step()
            done = wanted
            moments.append(world.bodies())
    finally:
        world.close()
    return moments
