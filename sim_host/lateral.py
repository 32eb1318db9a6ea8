"""Lateral positions of vehicles in their lanes: offsets that drift slowly along the route.

SUMO drives in the middle of lanes. Its sublane model would give a lateral position, too, but takes
four times as long for a step and drives otherwise; so a vehicle's offset is drawn here, from its id
and the scenario's seed, and is a function of the distance driven: a mean of its own, and waves on
top of it, as in the two levels (coarse profile, fine movement) of Neis and Beyerer (2024),
arXiv:2405.17080. A vehicle that stands keeps its place.
"""

from __future__ import annotations

from bisect import bisect_right
from itertools import pairwise
from math import atan2, hypot
from typing import Any

import numpy as np

from protocol.geometry import Floats
from protocol.messages import VehicleType
from sensing.noise import stream
from sim_host.config import LateralConfig

_WAVES = 3
_WAVE_M = (80.0, 320.0)  # one drift to the side and back: 6 to 23 s at 50 km/h; ours
_MARGIN_M = 0.15  # that stays free between a vehicle and its lane's edge
BICYCLE = "bicycle"


class LateralPositions:
    """The offsets of vehicles from their lanes' middles, drawn once each."""

    def __init__(self, config: LateralConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._drawn: dict[str, Floats] = {}

    @property
    def all_centred(self) -> bool:
        """Whether all vehicles drive in the middle."""
        config = self._config
        return not (config.offset_std_m or config.wander_std_m or config.bicycle_edge_m)

    def offsets_m(
        self,
        vehicles: list[str],
        types: list[VehicleType],
        driven_m: Floats,
        lane_widths_m: Floats,
    ) -> tuple[Floats, Floats]:
        """Returns how far left of the middle each vehicle is (N,), m, and its slope (N,), rad.

        Args:
            vehicles: SUMO's ids (N,).
            types: of the vehicles (N,).
            driven_m: since each one's start (N,).
            lane_widths_m: of the lanes that they are on (N,).
        """
        known = self._drawn
        self._drawn = {
            name: known[name] if name in known else self._draw(name) for name in vehicles
        }
        drawn = np.array([*self._drawn.values()]).reshape(-1, 3, _WAVES + 1)
        amplitude, turns_per_m, phase = drawn[:, 0], drawn[:, 1], drawn[:, 2]
        angle = turns_per_m * driven_m[:, None] + phase
        wanted = (amplitude * np.sin(angle)).sum(axis=1)
        slope = (amplitude * turns_per_m * np.cos(angle)).sum(axis=1)
        widths = np.array([kind.width_m for kind in types])
        room = np.maximum((lane_widths_m - widths) / 2 - _MARGIN_M, 0.01)
        base = self._base_m(types, lane_widths_m, room)
        # Towards its lane's edges a vehicle drifts ever less: it never leaves its lane.
        bounded = np.tanh((base + wanted) / room)
        return room * bounded, np.arctan(slope * (1 - bounded**2))

    def _draw(self, vehicle: str) -> Floats:
        """Returns amplitudes in m, rad per m and phases in rad (3, W + 1); the mean comes last."""
        config = self._config
        rng = stream(self._seed, "lateral", vehicle)
        share_m = config.wander_std_m * np.sqrt(2 / _WAVES)  # a sine's deviation is 1/sqrt(2)
        turns_per_m = 2 * np.pi / rng.uniform(*_WAVE_M, _WAVES)
        phase = rng.uniform(0, 2 * np.pi, _WAVES)
        mean_m = config.offset_std_m * rng.standard_normal()
        return np.array(
            [
                [*np.full(_WAVES, share_m), mean_m],
                [*turns_per_m, 0.0],
                [*phase, np.pi / 2],
            ]
        )

    def _base_m(self, types: list[VehicleType], lane_widths_m: Floats, room: Floats) -> Floats:
        """Returns mean lateral positions (N,): bicycles at the right, others in the middle."""
        edge_m = self._config.bicycle_edge_m
        if not edge_m:
            return np.zeros(len(types))
        rides_right = np.array([kind.mesh == BICYCLE for kind in types], np.bool_)
        # The argument for which `tanh` gives the wanted distance.
        share = np.clip((lane_widths_m / 2 - edge_m) / room, 0, 0.98)
        return np.where(rides_right, -room * np.arctanh(share), 0.0)


_JOINT_M = 1.0  # between lanes that follow each other, at most
_SLOWEST_MPS = 5.0  # bounds how far a vehicle turns to change lanes: by 8 degrees in 5 s


class LaneHeadings:
    """Headings along lanes, of vehicles whose lane changes take time.

    SUMO turns such a vehicle by its direction of motion, which is sideways for one that hardly
    moves: it may stand across two lanes for a whole red.
    """

    def __init__(self, sumo: Any) -> None:  # noqa: ANN401 - libsumo is untyped
        self._sumo = sumo
        self._lines: dict[str, tuple[list[float], list[tuple[float, float]], float]] = {}
        self._trails: dict[str, tuple[str, str]] = {}  # the lane of each vehicle, and that before

    def yaws_rad(
        self, vehicles: list[str], lanes: list[str], lengths_m: Floats, yaws_rad: Floats
    ) -> Floats:
        """Returns headings (N,) in rad, along the lanes from the vehicles' rears to their fronts.

        Args:
            vehicles: SUMO's ids (N,).
            lanes: on which they are (N,).
            lengths_m: of the vehicles (N,).
            yaws_rad: headings that SUMO has (N,), for those of whose rear the lane is not known.
        """
        api = self._sumo.vehicle
        self._follow(vehicles, lanes)
        found = yaws_rad.copy()
        for n, (name, lane) in enumerate(zip(vehicles, lanes, strict=True)):
            front_m = api.getLanePosition(name)
            aside_mps = api.getLateralSpeed(name)
            rear_m = front_m - float(lengths_m[n])
            if rear_m >= 0:
                x, y = self._place(lane, rear_m)
            elif self._leads_to(before := self._trails[name][1], lane):
                x, y = self._place(before, self._length_m(before) + rear_m)
            elif aside_mps or api.getLateralLanePosition(name):
                x, y = self._place(lane, 0.0)
            else:
                continue
            to_x, to_y = self._place(lane, max(front_m, 0.1))
            turn = atan2(aside_mps, max(api.getSpeed(name), _SLOWEST_MPS))
            found[n] = atan2(to_y - y, to_x - x) + turn
        return found

    def _follow(self, vehicles: list[str], lanes: list[str]) -> None:
        """Notes the lanes, and those before where they have changed."""
        known = self._trails
        self._trails = {}
        for name, lane in zip(vehicles, lanes, strict=True):
            now, before = known.get(name, (lane, ""))
            self._trails[name] = (lane, before if now == lane else now)

    def _leads_to(self, before: str, lane: str) -> bool:
        """Whether a lane ends where another begins."""
        if not before:
            return False
        x, y = self._place(before, self._length_m(before))
        to_x, to_y = self._place(lane, 0.0)
        return hypot(to_x - x, to_y - y) < _JOINT_M

    def _length_m(self, lane: str) -> float:
        along_m, _, scale = self._line(lane)
        return along_m[-1] / scale

    def _place(self, lane: str, position_m: float) -> tuple[float, float]:
        """Returns x, y at SUMO's position on a lane."""
        along_m, shape, scale = self._line(lane)
        at_m = max(position_m, 0.0) * scale
        k = min(max(bisect_right(along_m, at_m) - 1, 0), len(shape) - 2)
        share = (at_m - along_m[k]) / max(along_m[k + 1] - along_m[k], 1e-9)
        (x, y), (to_x, to_y) = shape[k], shape[k + 1]
        return x + share * (to_x - x), y + share * (to_y - y)

    def _line(self, lane: str) -> tuple[list[float], list[tuple[float, float]], float]:
        """Returns a lane's corners with how far along it each lies, m, and m per m of SUMO's."""
        if lane not in self._lines:
            shape = self._sumo.lane.getShape(lane)
            along_m = [0.0]
            for (x, y), (to_x, to_y) in pairwise(shape):
                along_m.append(along_m[-1] + hypot(to_x - x, to_y - y))
            scale = along_m[-1] / self._sumo.lane.getLength(lane)
            self._lines[lane] = along_m, list(shape), scale
        return self._lines[lane]
