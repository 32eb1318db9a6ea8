"""Where in its lane a vehicle drives: beside the middle, by what drifts slowly along its way.

SUMO drives in the middle of lanes. Its sublane model would give a lateral position, too, but takes
four times as long for a step and drives otherwise; so a vehicle's offset is drawn here, from its id
and the scenario's seed, and is a function of the distance driven: a mean of its own, and waves on
top of it, as in the two levels (coarse profile, fine movement) of Neis and Beyerer (2024),
arXiv:2405.17080. A vehicle that stands keeps its place.
"""

from __future__ import annotations

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
    def are_off(self) -> bool:
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
        """Returns where each kind drives (N,): bicycles at the right, others in the middle."""
        edge_m = self._config.bicycle_edge_m
        if not edge_m:
            return np.zeros(len(types))
        rides_right = np.array([kind.mesh == BICYCLE for kind in types], np.bool_)
        # What `tanh` will turn into the distance that was asked for.
        share = np.clip((lane_widths_m / 2 - edge_m) / room, 0, 0.98)
        return np.where(rides_right, -room * np.arctanh(share), 0.0)
