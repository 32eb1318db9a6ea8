"""The static world as a sensor sees it."""

from __future__ import annotations

import numpy as np

from perception.arrays import Floats32
from protocol.geometry import SE3
from protocol.scans import ScanPattern
from sensing.candidates import turn
from sensing.embree import Caster
from sensing.scene import Scene


class StaticWorld:
    """Casts whole patterns into the scene."""

    def __init__(self, scene: Scene, pattern: ScanPattern) -> None:
        self._shape = pattern.channels, pattern.columns
        self._caster = Caster(scene.mesh)
        self._directions = np.ascontiguousarray(pattern.directions.reshape(-1, 3).T)
        self._turned = np.empty_like(self._directions)

    def cast(self, map_SE3_sensor: SE3, range_m: float) -> Floats32:
        """Returns clean distances (channels, columns); `range_m` where nothing is."""
        distance_m = np.full(self._shape, range_m, np.float32)
        start = map_SE3_sensor.translation.astype(np.float32).reshape(3, 1)
        turn(self._directions, map_SE3_sensor.rotation.astype(np.float32), self._turned)
        self._caster.cast(start, self._turned, distance_m.reshape(-1))
        return distance_m
