"""The static world as a sensor sees it."""

from __future__ import annotations

import math

import numpy as np

from perception.arrays import Floats32
from protocol.codec import ScanPattern
from protocol.geometry import SE3
from sensing.candidates import turn
from sensing.embree import Caster
from sensing.landing import Landing
from sensing.scene import Scene


class StaticWorld:
    """Casts whole patterns into the scene.

    The rings that fall steeply meet the ground by a cheaper way than Embree's, which then only
    looks for what stands in between; the others are cast into everything.
    """

    def __init__(self, scene: Scene, pattern: ScanPattern) -> None:
        self._pattern = pattern
        self._everything, self._objects = Caster(scene.mesh), Caster(scene.objects)
        self._landing = Landing(scene.terrain)
        beams = pattern.channels * pattern.columns
        self._origins = np.empty((beams, 3), np.float32)
        self._directions = np.empty((beams, 3), np.float32)

    def cast(self, map_SE3_sensor: SE3, range_m: float) -> Floats32:
        """Returns clean distances (channels, columns); `range_m` where nothing is."""
        pattern, directions, origins = self._pattern, self._directions, self._origins
        turn(pattern.directions.reshape(-1, 3), map_SE3_sensor.rotation.copy(), directions)
        position = map_SE3_sensor.translation
        origins[:] = position
        distance_m = np.full(pattern.channels * pattern.columns, range_m, np.float32)
        steep = self._first_steep_ring(map_SE3_sensor) * pattern.columns
        self._landing.cast(position, directions[steep:], distance_m[steep:])
        self._objects.cast(origins[steep:], directions[steep:], distance_m[steep:])
        self._everything.cast(origins[:steep], directions[:steep], distance_m[:steep])
        return distance_m.reshape(pattern.channels, pattern.columns)

    def _first_steep_ring(self, map_SE3_sensor: SE3) -> int:
        """Returns the first ring that falls steeply enough all around, tilted as the sensor is."""
        needed_rad = math.atan(self._landing.steepness(map_SE3_sensor.translation))
        tilt_rad = math.acos(min(1.0, max(-1.0, float(map_SE3_sensor.rotation[2, 2]))))
        pattern = self._pattern
        elevations = np.radians(
            np.linspace(pattern.upper_fov_deg, pattern.lower_fov_deg, pattern.channels)
        )
        return pattern.channels - int(np.count_nonzero(elevations + tilt_rad < -needed_rad))
