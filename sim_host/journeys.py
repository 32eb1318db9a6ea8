"""Journeys of vehicles: names, types, equipment, and how they end."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from protocol.messages import PARKED, PEDESTRIAN, Equipment, ObjectClass, Setup, Trip, VehicleType
from sim_host.demand import sized
from sim_host.setup import traffic_config
from sim_host.vehicle_meshes import BOX


def draw_equipment(seed: int, vehicle: str, cav_rate: float, cv_rate: float) -> Equipment:
    """Draws a vehicle's equipment: none, CV or CAV.

    One uniform number decides, so a higher rate keeps every CAV that a lower rate had.
    """
    sequence = np.random.SeedSequence([seed, zlib.crc32(vehicle.encode())])
    uniform = int(sequence.generate_state(1)[0]) / 2**32
    if uniform < cav_rate:
        return Equipment.CAV
    return Equipment.CV if uniform < cav_rate + cv_rate else Equipment.NONE


HALTED_MPS = 0.1  # slower is a stop, as in SUMO
_EQUIPPED = (ObjectClass.CAR, ObjectClass.TRUCK)
_UNSAFE = re.compile(rf"[/*$?#\s]|^(?={PARKED}|{PEDESTRIAN})")  # prefixes of bystanders


@dataclass(slots=True)
class Journey:
    """One vehicle, from when it first came within the radius.

    SUMO counts a vehicle's loss from its start; `lost_outside_s` of it was lost outside the radius.
    """

    name: str
    type: VehicleType
    equipment: Equipment
    depart_s: float
    over_signal: bool
    lost_outside_s: float
    lost_s: float
    within_radius: bool = True
    teleported: bool = False
    is_halted: bool = False
    stops: int = 0
    co2_g: float = 0.0

    def trip(self, arrive_s: float | None) -> Trip:
        """Returns the journey as a message."""
        return Trip(
            vehicle=self.name,
            equipment=self.equipment,
            depart_s=self.depart_s,
            arrive_s=arrive_s,
            time_loss_s=self.lost_s - self.lost_outside_s,
            teleported=self.teleported,
            stops=self.stops,
            co2_g=self.co2_g,
        )


class Journeys:
    """The journeys under way, by SUMO's vehicle id, and those that ended."""

    def __init__(self, setup: Setup, seed: int, sumo: Any) -> None:  # noqa: ANN401 - libsumo is untyped
        self._traffic = traffic_config(setup.scenario)
        self._types = {kind.name: kind for kind in setup.vehicle_types}
        self._approaches = {lane.rpartition("_")[0] for lane in setup.road_map.incoming}
        self._seed = seed
        self._sumo = sumo
        self._fallbacks: dict[str, VehicleType] = {}
        self._under_way: dict[str, Journey] = {}
        self._ended: list[Trip] = []

    def within_radius(self, vehicles: list[str]) -> list[Journey]:
        """Returns the journeys of all vehicles that are within the radius now; new ones begin."""
        journeys = [self._of(vehicle) for vehicle in vehicles]
        for journey in self._under_way.values():
            journey.within_radius = False
        for journey in journeys:
            journey.within_radius = True
        return journeys

    def _of(self, vehicle: str) -> Journey:
        """Returns a vehicle's journey; what it lost while it was outside is not the run's."""
        journey = self._under_way.get(vehicle)
        if journey is None:
            journey = self._under_way[vehicle] = self._begin(vehicle)
        elif not journey.within_radius:
            lost_s = self._sumo.vehicle.getTimeLoss(vehicle)
            journey.lost_outside_s += lost_s - journey.lost_s
            journey.lost_s = lost_s
        return journey

    def note_step(self) -> None:
        """Reads each vehicle's time loss, which SUMO forgets, and its halts and emissions."""
        api, step_s = self._sumo.vehicle, self._traffic.step_s
        for vehicle in api.getIDList():
            journey = self._under_way.get(vehicle)
            if journey is not None and journey.within_radius:
                journey.lost_s = api.getTimeLoss(vehicle)
                journey.co2_g += api.getCO2Emission(vehicle) * step_s / 1000
                was_halted = journey.is_halted
                journey.is_halted = api.getSpeed(vehicle) < HALTED_MPS
                journey.stops += journey.is_halted and not was_halted

    def note_teleport(self, vehicle: str) -> None:
        """Marks a vehicle that SUMO moved because it was stuck or had collided."""
        if vehicle in self._under_way:
            self._under_way[vehicle].teleported = True

    def end(self, vehicle: str, arrive_s: float) -> None:
        """Ends the journey of a vehicle that has arrived."""
        journey = self._under_way.pop(vehicle, None)
        if journey is not None and journey.over_signal:
            self._ended.append(journey.trip(arrive_s))

    def take_ended(self) -> list[Trip]:
        """Returns the journeys over the signal that ended since the last call."""
        ended, self._ended = self._ended, []
        return ended

    def unfinished(self) -> list[Trip]:
        """Returns the journeys over the signal that are under way, sorted by vehicle."""
        journeys = [self._under_way[vehicle] for vehicle in sorted(self._under_way)]
        return [journey.trip(None) for journey in journeys if journey.over_signal]

    def _begin(self, vehicle: str) -> Journey:
        api, traffic = self._sumo.vehicle, self._traffic
        kind = self.type_of(api.getTypeID(vehicle))
        drawn = draw_equipment(self._seed, vehicle, traffic.cav_rate, traffic.cv_rate)
        lost_s = api.getTimeLoss(vehicle)
        carries = kind.object_class in _EQUIPPED and kind.mesh != BOX  # trams carry nothing
        return Journey(
            name=safe_id(vehicle),
            type=kind,
            equipment=drawn if carries else Equipment.NONE,
            depart_s=api.getDeparture(vehicle),
            over_signal=not self._approaches.isdisjoint(api.getRoute(vehicle)),
            lost_outside_s=lost_s,
            lost_s=lost_s,
        )

    def type_of(self, name: str) -> VehicleType:
        """Returns a type of the setup: the one of this name, or the nearest in shape and size."""
        base = name.split("@")[0]  # SUMO's copy of a type that was changed for one vehicle
        known = self._types.get(name) or self._types.get(base) or self._fallbacks.get(name)
        return known or self._fallbacks.setdefault(name, self._nearest(name))

    def _nearest(self, name: str) -> VehicleType:
        api = self._sumo.vehicletype
        given = {
            "length": str(api.getLength(name)),
            "width": str(api.getWidth(name)),
            "height": str(api.getHeight(name)),
        }
        wanted = sized(name, api.getVehicleClass(name), given)
        return min(
            (self._types[key] for key in sorted(self._types)),
            key=lambda kind: (
                kind.mesh != wanted.mesh,
                abs(kind.length_m - wanted.length_m)
                + abs(kind.width_m - wanted.width_m)
                + abs(kind.height_m - wanted.height_m),
            ),
        )


def safe_id(vehicle: str) -> str:
    """Returns the id, or a replacement that is allowed in a topic's key."""
    clean = _UNSAFE.sub("_", vehicle)
    return vehicle if clean == vehicle else f"{clean}~{zlib.crc32(vehicle.encode()):08x}"
