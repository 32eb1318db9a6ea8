"""Lane graph as arrays: the lane of a box, a lane's successors, the position along a lane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bools, Bytes, Floats, Ints
from protocol.roadmap import RoadMap

CELL_M = 20.0
MOST_CELLS = 1 << 20  # of a map; one that reaches farther has larger cells
SHORTEST_M = 1e-6
REACH_M = 4.0  # beyond a lane's middle: a box farther from it is on no lane
TURNED_RAD = 0.7  # a box at a larger angle to a lane is not on it
LEVEL_M = 3.5  # nor is one so far above or below it
UNKNOWN, STOP, GO = 0, 1, 2  # what a signal shows to those who approach
STOPS = ("r", "R", "y", "Y", "u")
PRIOR_TRIPS = 4.0  # what the shape of a junction is worth, in vehicles seen


@dataclass(frozen=True, slots=True, eq=False)
class LaneGraph:
    """Lanes (L,) as segments (S,), and the lanes (E,) that they lead to.

    `segments` (S, 9) are two ends x, y, z, metres before it, its length, its heading; those of lane
    i are `first[i]` to `first[i + 1]`. `followers[leads[i]:leads[i + 1]]` are the lanes after lane
    i. `cells` has for each square of the plane the segments near it: `near[cells[c]:cells[c + 1]]`,
    on a `grid` (5,) of origin x and y, side, columns and rows. `links` has by signal the numbers of
    its lights and the connections into the junction that they control. `at_signal` marks the lanes
    (L,) that end at a signal.
    """

    segments: Floats
    owner: Ints
    first: Ints
    length_m: Floats
    speed_mps: Floats
    leads: Ints
    followers: Ints
    prior: Floats
    grid: Floats
    cells: Ints
    near: Ints
    links: Mapping[str, list[tuple[int, int]]]
    at_signal: Bools

    @classmethod
    def of(cls, road_map: RoadMap) -> LaneGraph:
        """Prepares a map's lanes."""
        number = {lane.id: index for index, lane in enumerate(road_map.lanes)}
        rows, owner, first, lengths_m = [], [], [0], []
        for index, lane in enumerate(road_map.lanes):
            points = lane.points if len(lane.points) > 1 else np.repeat(lane.points, 2, axis=0)
            steps = np.diff(points, axis=0)
            long_m = np.maximum(np.linalg.norm(steps[:, :2], axis=1), SHORTEST_M)
            kept = long_m > SHORTEST_M
            kept[0] |= not kept.any()  # each lane has a place
            before_m = np.concatenate([[0.0], np.cumsum(long_m)[:-1]])
            heading = np.arctan2(steps[:, 1], steps[:, 0])
            ends = [points[:-1], points[1:], before_m, long_m, heading]
            rows.append(np.column_stack(ends)[kept])
            owner += [index] * int(kept.sum())
            first.append(len(owner))
            lengths_m.append(float(long_m.sum()))
        segments = np.concatenate(rows)
        after = [[number[n] for n in lane.successors if n in number] for lane in road_map.lanes]
        leads = np.concatenate([[0], np.cumsum([len(one) for one in after])]).astype(np.int64)
        followers = np.array([lane for one in after for lane in one], np.int64)
        starts = np.array(first, np.int64)
        grid, cells, near = _cells(segments)
        at_signal = np.zeros(len(number), np.bool_)
        signals = [one.signal.links for one in road_map.intersections]
        starts_of = {link.from_lane for links in signals for link in links}
        at_signal[[number[lane] for lane in sorted(starts_of) if lane in number]] = True
        return cls(
            segments=segments,
            owner=np.array(owner, np.int64),
            first=starts,
            length_m=np.array(lengths_m),
            speed_mps=np.array([lane.speed_mps for lane in road_map.lanes]),
            leads=leads,
            followers=followers,
            prior=_straightness(segments, starts, leads, followers),
            grid=grid,
            cells=cells,
            near=near,
            links=_links(road_map, number, leads, followers),
            at_signal=at_signal,
        )

    def lights(self, states: Mapping[str, str]) -> Bytes:
        """Returns what signals show for each connection (E,): stop, go, or unknown.

        Args:
            states: by signal a letter for each of its lights, as in SUMO. Whether those that have
                to give way (g) go is unknown.
        """
        result = np.zeros(len(self.followers), np.uint8)
        for tls, state in states.items():
            for light, way in self.links.get(tls, ()):
                letter = state[light] if light < len(state) else ""
                result[way] = GO if letter == "G" else STOP if letter in STOPS else UNKNOWN
        return result

    def held(self, states: Mapping[str, str]) -> Bools:
        """Marks the lanes (L,) that end at a signal which shows go for none of their connections.

        The argument is as of `lights`.
        """
        goes = np.zeros(len(self.length_m), np.bool_)
        ways_of = np.repeat(np.arange(len(goes)), np.diff(self.leads))
        goes[ways_of[self.lights(states) == GO]] = True
        return np.asarray(self.at_signal & ~goes)

    def locate(self, boxes: Floats) -> tuple[Ints, Floats, Floats]:
        """Finds the lane of each box (N, 7): its index (N,), -1 for none, metres along and off.

        Metres off (N,) are to the left of the lane's middle.
        """
        rows = np.ascontiguousarray(boxes, np.float64)
        lane, along_m, off_m = _locate(
            rows, self.segments, self.owner, self.grid, self.cells, self.near
        )
        return lane, along_m, off_m


def _links(
    road_map: RoadMap, number: Mapping[str, int], leads: Ints, followers: Ints
) -> dict[str, list[tuple[int, int]]]:
    """Returns by signal its lights, each with the connections that it controls."""
    result: dict[str, list[tuple[int, int]]] = {}
    internal = {number[lane.id] for lane in road_map.lanes if lane.internal}
    for one in road_map.intersections:
        found = result.setdefault(one.tls, [])
        for link in one.signal.links:
            start, end = number.get(link.from_lane, -1), number.get(link.to_lane, -1)
            ways = range(leads[start], leads[start + 1]) if start >= 0 else range(0)
            found += [
                (link.index, way)
                for way in ways
                if _end(int(followers[way]), internal, leads, followers) == end
            ]
    return result


def _end(lane: int, internal: set[int], leads: Ints, followers: Ints) -> int:
    """Returns the lane behind a junction that a lane inside it leads to."""
    for _ in range(len(internal)):
        if lane not in internal or leads[lane] == leads[lane + 1]:
            break
        lane = int(followers[leads[lane]])
    return lane


def _straightness(segments: Floats, first: Ints, leads: Ints, followers: Ints) -> Floats:
    """Returns prior counts of vehicles for each connection (E,): most go straight on."""
    prior = np.zeros(len(followers))
    for lane in range(len(leads) - 1):
        ways = np.arange(leads[lane], leads[lane + 1])
        if not len(ways) or first[lane + 1] == first[lane]:
            continue
        out = segments[first[lane + 1] - 1, 8]
        last = [segments[max(first[follower + 1] - 1, 0), 8] for follower in followers[ways]]
        weight = 1.25 + np.cos(np.array(last) - out)
        prior[ways] = PRIOR_TRIPS * weight**2 / (weight**2).sum()
    return prior


def _cells(segments: Floats) -> tuple[Floats, Ints, Ints]:
    """Returns a grid and the segments near each of its cells."""
    low = np.minimum(segments[:, 0:2], segments[:, 3:5]) - REACH_M
    high = np.maximum(segments[:, 0:2], segments[:, 3:5]) + REACH_M
    span_m = high.max(axis=0) - low.min(axis=0)
    side_m = max(CELL_M, float(np.sqrt(np.prod(span_m) / MOST_CELLS)))
    origin = np.floor(low.min(axis=0) / side_m) * side_m
    columns, rows = (np.floor((high.max(axis=0) - origin) / side_m) + 1).astype(int).tolist()
    first = np.floor((low - origin) / side_m).astype(int)
    last = np.floor((high - origin) / side_m).astype(int)
    inside: list[list[int]] = [[] for _ in range(columns * rows)]
    for segment in range(len(segments)):
        for row in range(first[segment, 1], last[segment, 1] + 1):
            for column in range(first[segment, 0], last[segment, 0] + 1):
                inside[row * columns + column].append(segment)
    cells = np.concatenate([[0], np.cumsum([len(one) for one in inside])]).astype(np.int64)
    near = np.array([segment for one in inside for segment in one], np.int64)
    return np.array([*origin, side_m, columns, rows]), cells, near


@njit(
    "Tuple((int64[::1], float64[::1], float64[::1]))(float64[:,::1], float64[:,::1], int64[::1], "
    "float64[::1], int64[::1], int64[::1])",
    cache=True,
)
def _locate(
    boxes: Floats, segments: Floats, owner: Ints, grid: Floats, cells: Ints, near: Ints
) -> tuple[Ints, Floats, Floats]:
    lane = np.full(boxes.shape[0], -1, np.int64)
    along_m, off_m = np.zeros(boxes.shape[0]), np.zeros(boxes.shape[0])
    for index in range(boxes.shape[0]):
        x, y, yaw = boxes[index, 0], boxes[index, 1], boxes[index, 6]
        z = boxes[index, 2] - boxes[index, 5] / 2  # of the ground that it stands on
        column, row = np.floor((x - grid[0]) / grid[2]), np.floor((y - grid[1]) / grid[2])
        if not (0 <= column < grid[3] and 0 <= row < grid[4]):
            continue
        cell = int(row * grid[3] + column)
        least = np.inf
        for place in range(cells[cell], cells[cell + 1]):
            x0, y0, z0, x1, y1, z1, before_m, long_m, heading = segments[near[place]]
            cos, sin = (x1 - x0) / long_m, (y1 - y0) / long_m
            ahead_m = min(max((x - x0) * cos + (y - y0) * sin, 0.0), long_m)
            gap_m = np.hypot(x - x0 - ahead_m * cos, y - y0 - ahead_m * sin)
            turned = abs((yaw - heading + np.pi) % (2 * np.pi) - np.pi)
            over_m = abs(z - z0 - (z1 - z0) * ahead_m / long_m)
            cost = gap_m + 2 * turned
            if gap_m < REACH_M and turned < TURNED_RAD and over_m < LEVEL_M and cost < least:
                least = cost
                lane[index] = owner[near[place]]
                along_m[index] = before_m + ahead_m
                off_m[index] = (y - y0) * cos - (x - x0) * sin
    return lane, along_m, off_m


@njit("int64(int64, int64[::1], float64[::1])", cache=True)
def likeliest(lane: int, leads: Ints, trips: Floats) -> int:
    """Returns the successor, an index into the followers, that most vehicles take; -1 for none."""
    best = -1
    for way in range(leads[lane], leads[lane + 1]):
        if best < 0 or trips[way] > trips[best]:
            best = way
    return best


@njit("UniTuple(float64, 4)(int64, float64, float64[:,::1], int64[::1])", cache=True)
def place_at(
    lane: int, along_m: float, segments: Floats, first: Ints
) -> tuple[float, float, float, float]:
    """Returns x, y, z and heading so far along a lane."""
    segment = first[lane]
    while segment + 1 < first[lane + 1] and along_m > segments[segment + 1, 6]:
        segment += 1
    x0, y0, z0, x1, y1, z1, before_m, long_m, heading = segments[segment]
    share = (along_m - before_m) / long_m
    return x0 + share * (x1 - x0), y0 + share * (y1 - y0), z0 + share * (z1 - z0), heading
