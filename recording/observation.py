"""Current state of a run, by junction and by region, from the messages received so far.

Used by live views: the terminal, and the recorder for the metrics page.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from protocol.messages import Detections, LaneCounts, Message, SignalRequest, SignalState
from protocol.roadmap import Intersection, RoadMap

AVERAGED_FRAMES = 50


@dataclass(slots=True)
class ObservedJunction:
    """A junction's newest signal state, counts and request; None before the first."""

    intersection: Intersection
    region: str
    state: SignalState | None = None
    counts: LaneCounts | None = None
    request: SignalRequest | None = None
    since_ns: int = 0

    @property
    def tls(self) -> str:
        """Id of its signal."""
        return self.intersection.tls

    @property
    def phase(self) -> int | None:
        """Number of the phase that has green, or that a change leads away from; None if odd."""
        greens = self.intersection.signal.greens
        green = None if self.state is None else self.state.green
        return greens.index(green) if green in greens else None

    @property
    def vehicles(self) -> int:
        """Vehicles counted before the stop bars."""
        return sum(self.counts.upstream.values()) if self.counts else 0

    @property
    def queued(self) -> int:
        """Of these, stationary ones."""
        return sum(self.counts.stationary_upstream.values()) if self.counts else 0

    @property
    def coverage(self) -> float | None:
        """Mean share of the lanes before the stop bars that sensors cover; None if unknown."""
        shares = self.counts.coverage_upstream.values() if self.counts else ()
        return sum(shares) / len(shares) if shares else None

    def unchanged_s(self, sim_time_ns: int) -> float:
        """Returns for how many simulated seconds the signal has shown its state."""
        return max(0, sim_time_ns - self.since_ns) / 1e9

    def take(self, message: LaneCounts | SignalState | SignalRequest) -> None:
        """Adds a message about its signal."""
        match message:
            case SignalRequest():
                self.request = message
            case LaneCounts():
                self.counts = message
            case SignalState():
                if self.state is None or self.state.state != message.state:
                    self.since_ns = message.sim_time_ns
                self.state = message


@dataclass(slots=True)
class ObservedRegion:
    """A region's frames, and the agents of the newest one; `complete` are the last few."""

    junctions: list[ObservedJunction]
    complete: deque[bool] = field(default_factory=lambda: deque(maxlen=AVERAGED_FRAMES))
    frame: int = -1
    frames: int = 0
    incomplete: int = 0
    agents: int = 0

    def take(self, counts: LaneCounts) -> None:
        """Adds the counts of one of its junctions; the first of a frame starts the frame."""
        if counts.frame == self.frame:
            return
        self.frame, self.agents = counts.frame, len(counts.agents)
        self.frames += 1
        self.incomplete += not counts.complete
        self.complete.append(counts.complete)


class Observation:
    """Tracks all junctions and regions of a run; a single one is the case of one in each table."""

    def __init__(self, road_map: RoadMap, regions: Mapping[str, Sequence[str]]) -> None:
        """Stores the signals of each region; those that are not on the map are ignored."""
        known = road_map.by_tls
        self.regions = {
            region: ObservedRegion([ObservedJunction(known[t], region) for t in own if t in known])
            for region, own in regions.items()
        }
        self.junctions = {one.tls: one for one in self._listed()}

    def take(self, message: Message) -> None:
        """Adds a message about a signal; others, and those of unknown signals, are ignored."""
        if not isinstance(message, LaneCounts | SignalState | SignalRequest):
            return
        if (junction := self.junctions.get(message.tls)) is None:
            return
        junction.take(message)
        if isinstance(message, LaneCounts):
            self.regions[junction.region].take(message)

    def _listed(self) -> Iterator[ObservedJunction]:
        for region in self.regions.values():
            yield from region.junctions


def joined_detections(one: Detections, other: Detections) -> Detections:
    """Returns the detections of two regions in a frame as one."""
    return Detections(
        frame=one.frame,
        sim_time_ns=one.sim_time_ns,
        agents=sorted({*one.agents, *other.agents}),
        boxes=np.concatenate([one.boxes, other.boxes]),
        scores=np.concatenate([one.scores, other.scores]),
        classes=np.concatenate([one.classes, other.classes]),
        lanes=one.lanes + other.lanes,
        distances_m=np.concatenate([one.distances_m, other.distances_m]),
        sources=one.sources + other.sources,
        track_ids=np.concatenate([one.track_ids, other.track_ids]),
        speeds_mps=np.concatenate([one.speeds_mps, other.speeds_mps]),
        coasted_s=np.concatenate([one.coasted_s, other.coasted_s]),
        ages_s=np.concatenate([one.ages_s, other.ages_s]),
        position_std_m=np.concatenate([one.position_std_m, other.position_std_m]),
        speed_std_mps=np.concatenate([one.speed_std_mps, other.speed_std_mps]),
    )
