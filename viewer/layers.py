"""Layers of a picture: boxes, truth, lamps, counts, cells; as arrays, texts and colours."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from edge_server.power_diagram import PLAIN, cells
from edge_server.tracking import FRAME_BIT
from perception.arrays import Floats
from perception.detector import LIDAR
from protocol.messages import Detections, LaneCounts, Plan, SignalState, Truth, VehicleType
from protocol.roadmap import Intersection, RoadMap
from recording.observation import ObservedJunction
from studies import palette

Rgb = tuple[int, int, int]
MAX_REMEMBERED = 256


def rgb(text: str) -> Rgb:
    """Reads `#rrggbb`."""
    number = int(text[1:], 16)
    return number >> 16, number >> 8 & 255, number & 255


class Colours:
    """Assigns each agent a colour, which it keeps when it comes again."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    def of(self, agents: Iterable[str]) -> Mapping[str, Rgb]:
        """Returns the colours of the present agents; a newcomer gets a rare one."""
        present = list(dict.fromkeys(agents))
        for agent in present:
            if agent in self._numbers:
                self._numbers[agent] = self._numbers.pop(agent)  # the newest stand last
        for agent in present:
            if agent not in self._numbers:
                taken = Counter(self._numbers[other] for other in present if other in self._numbers)
                self._numbers[agent] = min(range(len(palette.AGENTS)), key=lambda n: (taken[n], n))
        while len(self._numbers) > max(MAX_REMEMBERED, len(present)):
            del self._numbers[next(iter(self._numbers))]
        return {agent: rgb(palette.AGENTS[self._numbers[agent]]) for agent in present}


CELLS_REACH_M = 120.0  # around the junctions' centres
CELLS_ABOVE_M = 0.3
TOTAL_ABOVE_M = 9.0  # over the signal heads
TRAIL_S, TRAIL_ABOVE_M = 5.0, 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Boxes (N, 7): x, y, z of the centre, length, width, height, yaw; each with its label."""

    values: Floats
    labels: list[str]
    colours: list[Rgb]


@dataclass(frozen=True, slots=True, eq=False)
class Texts:
    """Texts at places (N, 3)."""

    places: Floats
    texts: list[str]
    colours: list[Rgb]


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Lines, each (K, 3), with a name and a colour each."""

    lines: list[Floats] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    colours: list[Rgb] = field(default_factory=list)


def detected(message: Detections, colours: Mapping[str, Rgb]) -> Boxes:
    """Returns the boxes of detections; one that reports itself has its agent's colour and name.

    Others have their track's id, without tracks their number in the message. Those that coast are
    faint.
    """
    labels = [_label(message, number) for number in range(len(message.lanes))]
    coasted = (message.coasted_s > 0).tolist()
    own = [
        _colour(source, is_coasted=is_coasted, colours=colours)
        for source, is_coasted in zip(message.sources, coasted, strict=True)
    ]
    return Boxes(message.boxes.astype(np.float64), labels, own)


class Trails:
    """Trails of tracks: their positions in the last `TRAIL_S` seconds."""

    def __init__(self) -> None:
        self._places: dict[int, list[tuple[int, Floats]]] = {}

    def of(self, message: Detections) -> Lines:
        """Adds a frame; returns the trail of each of its tracks that was there before."""
        now_ns, found = message.sim_time_ns, Lines()
        before, self._places = self._places, {}
        for track, box in zip(message.track_ids.tolist(), message.boxes.tolist(), strict=True):
            if not track:
                continue
            place = np.array([box[0], box[1], box[2] - box[5] / 2 + TRAIL_ABOVE_M])
            known = [
                one for one in before.get(track, []) if now_ns - TRAIL_S * 1e9 <= one[0] < now_ns
            ]
            self._places[track] = [*known, (now_ns, place)]
            if known:
                found.lines.append(np.stack([at for _, at in self._places[track]]))
                found.names.append(short_name(track))
                found.colours.append(rgb(palette.FAINT))
        return found


def fronts(message: Detections) -> Texts:
    """Returns the labels of the first vehicle of each lane before the stop bar.

    Those of all boxes would hide one another; a vehicle that reports itself has a name already.
    """
    ways_m = message.distances_m.tolist()
    first: dict[str, int] = {}
    for number in sorted(range(len(ways_m)), key=ways_m.__getitem__):
        if ways_m[number] >= 0 and message.lanes[number]:
            first.setdefault(message.lanes[number], number)
    numbers = sorted(n for n in first.values() if message.sources[n] == LIDAR)
    tops = message.boxes[numbers].astype(np.float64)
    places = tops[:, :3] + np.outer(tops[:, 5], [0.0, 0.0, 0.5])
    texts = [_label(message, number) for number in numbers]
    return Texts(places, texts, [rgb(palette.BOX)] * len(texts))


def true_boxes(message: Truth, types: Mapping[str, VehicleType]) -> Boxes:
    """Returns the vehicles as they truly are; of an unknown type nothing is drawn."""
    rows, labels = [], []
    vehicles = zip(message.ids, message.types, message.lanes, message.poses.tolist(), strict=True)
    for vehicle, kind_name, lane, (x, y, z, _, _, yaw) in vehicles:
        if (kind := types.get(kind_name)) is not None:
            size = kind.length_m, kind.width_m, kind.height_m
            rows.append((x, y, z + kind.height_m / 2, *size, yaw))
            labels.append(f"{vehicle} · {lane}")
    values = np.array(rows, np.float64).reshape(-1, 7)
    return Boxes(values, labels, [rgb(palette.TRUTH)] * len(labels))


def lamps(states: Mapping[str, SignalState], road_map: RoadMap, lanes: Sequence[str]) -> list[Rgb]:
    """Returns the colour that each lane is shown: green if any of its links is.

    `states` are by the id of the signal.
    """
    letters: dict[str, list[str]] = {}
    for one in road_map.intersections:
        shown = states[one.tls].state if one.tls in states else ""
        for link in one.signal.links:
            letters.setdefault(link.from_lane, []).append(shown[link.index : link.index + 1])
    return [_lamp(letters.get(lane, ())) for lane in lanes]


def lane_counts(
    messages: Iterable[LaneCounts], places_of: Mapping[tuple[str, str], Floats]
) -> Texts:
    """Returns the count of each lane, before the stop bars and, fainter, behind them.

    Places are those of `viewer.road.count_places`. A lane that no sensor covers has a question
    mark.
    """
    places, texts, colours = [], [], []
    sides = [
        side
        for message in messages
        for side in (
            ("upstream", message.upstream, message.coverage_upstream, palette.TEXT),
            ("downstream", message.downstream, message.coverage_downstream, palette.FAINT),
        )
    ]
    for side, counts, seen, colour in sides:
        for name, count in counts.items():
            if (place := places_of.get((side, name))) is not None:
                places.append(place)
                texts.append(f"{count}" if seen.get(name, 1.0) > 0 else f"{count}?")
                colours.append(rgb(colour))
    return Texts(np.array(places, np.float64).reshape(-1, 3), texts, colours)


def junction_totals(junctions: Iterable[ObservedJunction]) -> Texts:
    """Returns at each junction its signal's id, and the counts before its stop bars.

    On narrow lines, for junctions may be near each other.
    """
    known = [one for one in junctions if one.counts is not None]
    places = np.array([one.intersection.centre for one in known], np.float64).reshape(-1, 3)
    texts = [f"{one.tls}: {one.vehicles}\n{one.queued} queued{_covered(one)}" for one in known]
    above = np.array([0.0, 0.0, TOTAL_ABOVE_M])
    return Texts(places + above, texts, [rgb(palette.TEXT)] * len(texts))


def _covered(junction: ObservedJunction) -> str:
    return "" if junction.coverage is None else f"\n{junction.coverage:.0%} covered"


@dataclass(frozen=True, slots=True, eq=False)
class CellArea:
    """Area in which the cells of agents are drawn: x, y of two corners (4,), and height."""

    box: Floats
    z_m: float

    @classmethod
    def around(cls, intersections: Sequence[Intersection]) -> CellArea:
        """Returns the area around at least one intersection."""
        centres = np.array([one.centre for one in intersections])
        x_y = centres[:, :2]
        corners = [x_y.min(axis=0) - CELLS_REACH_M, x_y.max(axis=0) + CELLS_REACH_M]
        return cls(np.concatenate(corners), float(centres[:, 2].mean()) + CELLS_ABOVE_M)


def plan_cells(
    plans: Mapping[str, Plan], areas: Mapping[str, CellArea], colours: Mapping[str, Rgb]
) -> Lines:
    """Returns the border of each agent's cell of the plan, by region; nothing without cells.

    An agent of two regions has a part in each.
    """
    found = Lines()
    for region, plan in plans.items():
        if region not in areas or not plan.agents:
            continue
        area = areas[region]
        parts = cells(np.array(plan.sites), np.array(plan.weights_m2), area.box, border=PLAIN)
        for agent, corners in zip(plan.agents, parts, strict=True):
            if len(corners) and agent in colours:
                ring = np.vstack([corners, corners[:1]])
                found.lines.append(np.column_stack([ring, np.full(len(ring), area.z_m)]))
                found.names.append(agent)
                found.colours.append(colours[agent])
    return found


def short_name(track: int) -> str:
    """Returns a track's id without its region and the edge's start; it is no long number then."""
    return f"#{track % (1 << FRAME_BIT)}"


def _label(message: Detections, number: int) -> str:
    """Returns the track's id or the agent, the lane, the speed, and how long it coasts."""
    source, track = message.sources[number], int(message.track_ids[number])
    name = source if source != LIDAR else short_name(track) if track else f"#{number}"
    parts = [name, message.lanes[number] or "off the lanes"]
    if track:
        parts.append(f"{3.6 * float(message.speeds_mps[number]):.0f} km/h")
    if message.coasted_s[number] > 0:
        parts.append(f"unseen for {message.coasted_s[number]:.1f} s")
    return " · ".join(parts)


def _colour(source: str, *, is_coasted: bool, colours: Mapping[str, Rgb]) -> Rgb:
    return rgb(palette.FAINT) if is_coasted else colours.get(source, rgb(palette.BOX))


def _lamp(letters: Iterable[str]) -> Rgb:
    known = min((one for one in letters if one and one in "Ggyr"), key="Ggyr".find, default="")
    return rgb(palette.SIGNAL.get(known, palette.FAINT))
