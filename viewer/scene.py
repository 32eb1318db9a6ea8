"""A frame as a picture: its messages, clouds, figures and layers, ready to be drawn."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from perception.arrays import Floats, Floats32
from protocol.codec import claimed_points, decode
from protocol.errors import CodecError, ConfigError, did_you_mean
from protocol.geometry import SE3
from protocol.messages import (
    Detections,
    LaneCounts,
    Message,
    Metrics,
    Plan,
    Scan,
    Setup,
    SignalRequest,
    SignalState,
    Truth,
    VehicleType,
)
from protocol.observer import BufferedFrame
from protocol.roadmap import Intersection, RoadMap, Signal
from recording.observation import ObservedJunction, joined_detections
from recording.rows import detection_rows, truth_rows
from recording.tables import TruthRow
from studies.ecvpr import EvaluationArea, FrameScore, parked_bodies, score_frame
from viewer import layers
from viewer.layers import Boxes, CellArea, Colours, Lines, Rgb, Texts
from viewer.road import Heads, approaches, count_places, heads
from viewer.stages import Rates, uploads_to

_Told = LaneCounts | Detections | Truth | SignalState | SignalRequest


@dataclass(slots=True, eq=False)
class Moment:
    """The messages of one frame, as far as they arrived and could be decoded.

    Those about a signal are by its id, plans by the region whose edge made them.
    """

    frame: int
    scans: list[Scan] = field(default_factory=list)
    detections: Detections | None = None
    truth: Truth | None = None
    counts: dict[str, LaneCounts] = field(default_factory=dict)
    states: dict[str, SignalState] = field(default_factory=dict)
    requests: dict[str, SignalRequest] = field(default_factory=dict)
    plans: dict[str, Plan] = field(default_factory=dict)

    @property
    def sim_time_ns(self) -> int | None:
        """The simulated time of the frame, None if no message has it."""
        told: list[_Told] = [*self.counts.values()]
        told += [one for one in (self.detections, self.truth) if one is not None]
        told += [*self.states.values(), *self.requests.values()]
        return told[0].sim_time_ns if told else None

    @classmethod
    def of(cls, frame: BufferedFrame, regions: Mapping[str, Collection[str]]) -> Moment:
        """Decodes the messages of a frame: of these signals, and uploads to their regions.

        Truth and detections are those of the whole run.
        """
        signals = {tls for shown in regions.values() for tls in shown}
        moment = cls(frame.number)
        for message, parts in frame.keyed_messages():
            is_of_region = isinstance(message, Scan | Plan)
            if is_of_region and parts.get("region") not in regions:
                continue
            if getattr(message, "tls", None) in {None, *signals}:
                moment.add(message, parts.get("region", ""))
        return moment

    def add(self, message: Message, region: str = "") -> None:
        """Adds a message; of two of a kind about the same the later counts."""
        match message:
            case Scan():
                self.scans.append(message)
            case Detections():
                known = self.detections
                self.detections = message if known is None else joined_detections(known, message)
            case Truth():
                self.truth = message
            case LaneCounts():
                self.counts[message.tls] = message
            case SignalState():
                self.states[message.tls] = message
            case SignalRequest():
                self.requests[message.tls] = message
            case Plan():
                self.plans[region] = message


MAX_POINTS = 50_000  # of a frame
MAX_AGENTS = 64
MAX_LISTED = 20  # names in an error
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """An agent's points (N, 3), and where its sensor stands (3,), both in the map frame."""

    agent: str
    points: Floats32
    sensor_m: Floats


def clouds(scans: Iterable[Scan], most_points: int = MAX_POINTS) -> list[Cloud]:
    """Returns a cloud per agent; of all points every n-th, so that no more than these are left.

    A chunk that cannot be decoded is left out.
    """
    by_agent: dict[str, list[Scan]] = defaultdict(list)
    for scan in scans:
        if scan.agent in by_agent or len(by_agent) < MAX_AGENTS:
            by_agent[scan.agent].append(scan)
    claimed = sum(claimed_points(scan.payload) for own in by_agent.values() for scan in own)
    step = max(1, -(-claimed // most_points))
    found = []
    for agent in sorted(by_agent):
        own = by_agent[agent]
        parts = [part for scan in own if (part := _placed(scan, step)) is not None]
        if parts:
            found.append(Cloud(agent, np.concatenate(parts), own[0].sensor_pose[:3].copy()))
    return found


def _placed(scan: Scan, step: int) -> Floats32 | None:
    try:
        points = decode(scan.payload).points
    except CodecError as error:
        _log.debug("chunk %d of %s is left out: %s", scan.chunk, scan.agent, error)
        return None
    map_SE3_sensor = SE3.from_pose(scan.sensor_pose)
    return map_SE3_sensor.apply(points[::step]).astype(np.float32)


class TruthScorer:
    """Compares detections with ground truth."""

    def __init__(
        self,
        road_map: RoadMap,
        types: Mapping[str, VehicleType],
        parked: Iterable[TruthRow] = (),
    ) -> None:
        self._reach = EvaluationArea(road_map)
        self._types = dict(types)
        self._parked = list(parked)

    def score(self, moment: Moment) -> FrameScore | None:
        """Returns a frame's score; None without truth or detections."""
        if moment.detections is None or moment.truth is None:
            return None
        found, vehicles = detection_rows(moment.detections, ""), truth_rows(moment.truth)
        bodies = [*vehicles, *self._parked]
        return score_frame(moment.frame, [*found], bodies, self._types, self._reach)


def junctions_to_show(road_map: RoadMap, tls: str | None) -> list[Intersection]:
    """Returns the intersection with this signal, or without one all.

    Raises:
        ConfigError: there is no such signal.
    """
    if tls is None:
        return road_map.intersections
    if tls not in road_map.by_tls:
        known = sorted(road_map.by_tls)
        raise ConfigError(
            f"--tls {tls}: none of the run's {len(known)} signals{did_you_mean(tls, known)}; "
            f"they are: {', '.join(known[:MAX_LISTED])}"
        )
    return [road_map.by_tls[tls]]


def phase_names(road_map: RoadMap, signal: Signal) -> list[str]:
    """Returns a name for each phase of a signal: who gets green, such as "east_in, west_in"."""
    names = []
    for green in signal.greens:
        lanes = [link.from_lane for link in signal.links if green[link.index] in "Gg"]
        names.append(", ".join(approaches(road_map, lanes)) or green)
    doubled = {name for name in names if names.count(name) > 1}
    return [f"{name} ({n + 1})" if name in doubled else name for n, name in enumerate(names)]


def pressures(request: SignalRequest | None, names: list[str]) -> dict[str, float]:
    """Returns the pressure of each phase; nothing where the policy knows none."""
    if request is None or len(request.pressures) != len(names):
        return {}
    return dict(zip(names, request.pressures, strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """All that is drawn of one frame; what no message contains is None."""

    frame: int
    sim_time_ns: int
    colours: Mapping[str, Rgb]
    clouds: list[Cloud]
    boxes: Boxes | None
    fronts: Texts | None
    trails: Lines | None
    truth: Boxes | None
    lamps: list[Rgb] | None
    counts: Texts | None
    totals: Texts | None
    cells: Lines
    mbps: dict[str, float]
    pressures: dict[str, float]
    queues: dict[str, int]
    score: FrameScore | None


class Scene:
    """Makes pictures of one run's moments: of all junctions, or of one.

    `road_map` has all lanes, and the junctions that are shown; `regions` their signals by region.
    `phases` are the names of an only junction's phases, none where several are shown.
    """

    def __init__(self, setup: Setup, tls: str | None = None) -> None:
        """Shows the junction with this signal, or all.

        Raises:
            ConfigError: the run has no such signal.
        """
        shown = junctions_to_show(setup.road_map, tls)
        self.setup = setup
        self.signals = [one.tls for one in shown]
        self.road_map = setup.road_map.part(setup.road_map.by_id, self.signals)
        self.regions = {
            region: here
            for region, own in setup.scenario["regions"].items()
            if (here := [tls for tls in own if tls in self.road_map.by_tls])
        }
        self.heads: Heads = heads(self.road_map)
        self.phases = phase_names(self.road_map, shown[0].signal) if len(shown) == 1 else []
        self._places = count_places(self.road_map)
        self._areas = {
            region: CellArea.around([self.road_map.by_tls[tls] for tls in own])
            for region, own in self.regions.items()
        }
        self._types = {kind.name: kind for kind in setup.vehicle_types}
        self._judge = TruthScorer(self.road_map, self._types, parked_bodies(setup))
        self._colours = Colours()
        self._trails = layers.Trails()
        self._rates = Rates(round(float(setup.scenario["frame_period_s"]) * 1e9))

    @property
    def is_overview(self) -> bool:
        """Whether several junctions are shown, and so no figures of a single one."""
        return len(self.signals) > 1

    def measured(self, metrics: Metrics) -> None:
        """Adds the metrics of a process: what it sent."""
        self._rates.take(uploads_to(metrics, self.regions))

    def picture(self, moment: Moment) -> Picture | None:
        """Returns the picture of a moment; None if its time is unknown."""
        sim_time_ns = moment.sim_time_ns
        if sim_time_ns is None:
            return None
        road_map, found, counts = self.road_map, moment.detections, moment.counts
        shown = clouds(moment.scans)
        said = found.agents if found else []
        colours = self._colours.of([cloud.agent for cloud in shown] + said)
        states, request = moment.states, moment.requests.get(self.signals[0])
        junctions = [
            ObservedJunction(self.road_map.by_tls[tls], region, counts=counts.get(tls))
            for region, own in self.regions.items()
            for tls in own
        ]
        return Picture(
            frame=moment.frame,
            sim_time_ns=sim_time_ns,
            colours=colours,
            clouds=shown,
            boxes=layers.detected(found, colours) if found else None,
            fronts=layers.fronts(found) if found else None,
            trails=self._trails.of(found) if found else None,
            truth=layers.true_boxes(moment.truth, self._types) if moment.truth else None,
            lamps=layers.lamps(states, road_map, self.heads.lanes) if states else None,
            counts=layers.lane_counts(counts.values(), self._places) if counts else None,
            totals=layers.junction_totals(junctions) if counts else None,
            cells=layers.plan_cells(moment.plans, self._areas, colours),
            mbps=self._rates.mbps(sim_time_ns),
            pressures=pressures(request, self.phases),
            queues={one.tls: one.queued for one in junctions if one.counts is not None},
            score=self._judge.score(moment),
        )
