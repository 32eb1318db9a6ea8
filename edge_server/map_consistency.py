"""Map consistency: whether an agent's position, heading and ground fit the road map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from edge_server.motion import fastest_mps
from perception.arrays import Floats, Floats32
from perception.roadway import Placed, Roadway, lane_segments
from protocol.regions import RegionMap
from protocol.roadmap import RoadMap

BESIDE_M = 1.5  # a lane's edge: still on the road, as far as the map is right
AWAY_M = 3.0  # beyond that: not on the road at all
CERTAIN = 4.0  # standard deviations
EDGE_M = 15.0  # around a lane's end that leads nowhere: the road goes on where no lane is drawn
ELSEWHERE_MPS = fastest_mps([36.1])  # where lanes are unknown: 130 km/h are allowed
ALONG_RAD, AGAINST_RAD = np.radians([60.0, 120.0])  # to the lane
AGAINST = 0.6  # the score of a vehicle that faces the wrong way: people park like that
NEAR_M = 25.0  # around a sensor, where its rings lie close together
LEVEL_M = 0.4  # how far the ground may lie over or below the map's road
LEAST_VOTES = 40  # squares of a metre
SENSOR_M = (0.0, 12.0)  # over the road, of a vehicle's sensor


class MapConsistency:
    """A region's road map, prepared for checks of agents."""

    def __init__(self, region: RegionMap, roadway: Roadway) -> None:
        self._region = region
        self._segments = lane_segments(region.surroundings)
        self._roadway = roadway
        self._open_ends = _open_ends(region.surroundings)
        self._fastest_mps = fastest_mps([lane.speed_mps for lane in region.surroundings.lanes])

    def fastest_mps(self, place: Floats) -> float:
        """Returns how fast a vehicle can be at a place (2,) or (3,)."""
        is_known = self._region.knows(float(place[0]), float(place[1]))
        return self._fastest_mps if is_known else max(self._fastest_mps, ELSEWHERE_MPS)

    def on_road(self, pose: Floats, std_m: float) -> float | None:
        """Returns how well a vehicle's pose (6,) fits the lanes; None where they are unknown."""
        x, y, _, _, _, yaw_rad = pose.tolist()
        if not self._region.knows(x, y):
            return None
        if (np.hypot(self._open_ends[:, 0] - x, self._open_ends[:, 1] - y) < EDGE_M).any():
            return None
        slack_m = BESIDE_M + CERTAIN * std_m
        beside_m, turned_rad = _nearest(self._segments, x, y, yaw_rad, slack_m)
        score = 1.0 - (beside_m - slack_m) / AWAY_M
        against = (turned_rad - ALONG_RAD) / (AGAINST_RAD - ALONG_RAD)
        return within(score) * (1.0 - (1.0 - AGAINST) * within(against))

    def on_ground(self, parts: Sequence[Placed], sensor_m: Floats, std_m: float) -> float | None:
        """Returns how much of the ground near a sensor (3,) lies where the map's road does.

        None where too few points show it. Only of clouds that hold the ground. An agent with a
        large position error is taken to have as large a height error.
        """
        level_m = LEVEL_M + CERTAIN * std_m
        level, deep, votes = 0, 0, 0
        for part in parts:
            found = _levels(part.lowest, float(sensor_m[0]), float(sensor_m[1]), level_m)
            level, deep, votes = level + found[0], deep + found[1], votes + found[2]
        if votes < LEAST_VOTES:
            return None
        return min(within((level / votes - 0.35) / 0.2), within((0.25 - deep / votes) / 0.2))

    def over_road_m(self, sensor_m: Floats) -> float | None:
        """Returns how high over the road a sensor (3,) is; None off the road."""
        place = np.array([sensor_m[:3]])
        if not self._roadway.contains(place)[0]:
            return None
        return float(sensor_m[2] - self._roadway.height_at(place)[0])


def _open_ends(road_map: RoadMap) -> Floats:
    """Returns the places (K, 2) where lanes begin or end and no other joins them."""
    starts = [lane.points[0] for lane in road_map.lanes if not road_map.predecessors[lane.id]]
    known = road_map.by_id.keys()
    ends = [lane.points[-1] for lane in road_map.lanes if not known & set(lane.successors)]
    return np.array([*starts, *ends], np.float64).reshape(-1, 3)[:, :2].copy()


def height(over_m: float | None) -> float | None:
    """Returns 1 if a vehicle's sensor can be so high over the road, else 0; None if unknown."""
    return None if over_m is None else float(SENSOR_M[0] <= over_m <= SENSOR_M[1])


def within(score: float) -> float:
    """Returns a score, cut off at 0 and 1."""
    return min(max(score, 0.0), 1.0)


@njit(
    "Tuple((float64, float64))(float64[:,::1], float64, float64, float64, float64)",
    cache=True,
    nogil=True,
)
def _nearest(
    segments: Floats, x: float, y: float, yaw: float, slack_m: float
) -> tuple[float, float]:
    """Returns how far beyond the nearest lane's edge a place lies, and its least turn to a lane.

    Of lanes within the slack.
    """
    least_m, least_rad = np.inf, np.pi
    for index in range(segments.shape[0]):
        x0, y0, _, x1, y1, _, half_m = segments[index]
        dx, dy = x1 - x0, y1 - y0
        square = max(dx * dx + dy * dy, 1e-12)
        share = min(max(((x - x0) * dx + (y - y0) * dy) / square, 0.0), 1.0)
        off_m = max(np.hypot(x - x0 - share * dx, y - y0 - share * dy) - half_m, 0.0)
        least_m = min(least_m, off_m)
        if off_m <= slack_m:
            turn_rad = abs(np.arctan2(dy, dx) - yaw) % (2 * np.pi)
            least_rad = min(least_rad, min(turn_rad, 2 * np.pi - turn_rad))
    return least_m, 0.0 if least_rad == np.pi else least_rad


@njit(
    "Tuple((int64, int64, int64))(float32[:,::1], float64, float64, float64)",
    cache=True,
    nogil=True,
)
def _levels(lowest: Floats32, x: float, y: float, level_m: float) -> tuple[int, int, int]:
    """Counts the lowest points near a place: those level with the road, those below, and all."""
    level, deep, votes = 0, 0, 0
    for vote in range(lowest.shape[0]):
        dx, dy, over_m = lowest[vote, 0] - x, lowest[vote, 1] - y, lowest[vote, 2]
        if dx * dx + dy * dy <= NEAR_M * NEAR_M:
            votes += 1
            level += abs(over_m) <= level_m
            deep += over_m < -level_m
    return level, deep, votes
