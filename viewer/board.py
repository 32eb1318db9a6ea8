"""Table rows of the terminal view, made from messages."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass

from protocol.inbox import Envelope, Presence
from protocol.messages import (
    AgentScore,
    End,
    LaneCounts,
    Message,
    Metrics,
    Progress,
    Setup,
    SignalState,
    Tick,
)
from protocol.topics import BusName
from recording.losses import DropCounts
from recording.observation import AVERAGED_FRAMES, Observation, ObservedJunction
from viewer.scene import junctions_to_show, phase_names, pressures
from viewer.stages import (
    GROUPS,
    MAX_RATED_AGENTS,
    FrameLatency,
    Rates,
    Stages,
    slowest,
    uploads_to,
)

BOARD_TOPICS = frozenset(
    {"tick", "metrics", "clock", "progress", "end", "state", "request", "lanes"}
)  # no scans: they are the largest messages
MAX_ALERTS = 64
STILL_NS = 3_000_000_000
_STAGES = (Tick, Metrics, LaneCounts)


@dataclass(frozen=True, slots=True)
class AgentRow:
    """An agent that uploads; `score` is its misbehaviour score at the edge, 0 to 1."""

    agent: str
    points: int
    mbps: float
    score: float
    trusted: bool


@dataclass(frozen=True, slots=True)
class StageRow:
    """A group of stages: of the newest frame, and on average, in ms."""

    stage: str
    newest_ms: float
    mean_ms: float


@dataclass(frozen=True, slots=True)
class LaneRow:
    """A lane's counts; `seen` is the share of it that sensors cover, None if unknown.

    Of the vehicles, `coasted` are those whose tracks coast: no sensor saw them in this frame.
    """

    lane: str
    vehicles: int
    queued: int
    coasted: int
    seen: float | None


@dataclass(frozen=True, slots=True)
class PhaseRow:
    """A phase of the signal; `is_shown` if it is green, or what a change leads to."""

    phase: str
    is_shown: bool
    pressure: float | None


@dataclass(frozen=True, slots=True)
class RegionRow:
    """A region: number of its frames, incomplete frames, its agents, Mbit/s, mean ms.

    Mbit/s are the recorder's, None until it publishes progress.
    """

    region: str
    junctions: int
    frames: int
    incomplete: int
    agents: int
    mbps: float | None
    mean_ms: float | None


@dataclass(frozen=True, slots=True)
class JunctionRow:
    """A junction: what its signal shows, since when, and its lanes before the stop bars.

    `covered` is the share of them that sensors cover, None if unknown.
    """

    tls: str
    region: str
    phase: str
    stage: str
    since_s: float | None
    vehicles: int
    queued: int
    covered: float | None


class Board:
    """State of the terminal view: collects a run's messages; rows are made on request.

    `junction` is the one that is shown alone, None of a board that shows several.
    """

    def __init__(self, setup: Setup, tls: str | None = None) -> None:
        """Shows one junction and its region, or all; a run's only junction is shown alone.

        Raises:
            ConfigError: the run has no such signal.
        """
        period_ns = round(float(setup.scenario["frame_period_s"]) * 1e9)
        shown = junctions_to_show(setup.road_map, tls)
        self.setup = setup
        self._observed = Observation(setup.road_map, setup.scenario["regions"])
        self.junction = self._observed.junctions.get(shown[0].tls) if len(shown) == 1 else None
        self._junctions = (
            [*self._observed.junctions.values()] if self.junction is None else [self.junction]
        )
        regions = {one.region for one in self._junctions}
        self._regions = {r: one for r, one in self._observed.regions.items() if r in regions}
        self._phases = {one.tls: phase_names(setup.road_map, one.signal) for one in shown}
        self.progress: Progress | None = None
        self.end: End | None = None
        self.sim_time_ns = 0
        self.frame = -1
        self._ticked_ns = 0
        self.present: dict[tuple[str, str], set[BusName]] = {}
        self.gone: set[tuple[str, str]] = set()
        self._rates = Rates(period_ns)
        self._stages = Stages(period_ns, setup.scenario["regions"])
        self._latencies: deque[FrameLatency] = deque(maxlen=AVERAGED_FRAMES)
        self._region_latencies: dict[str, deque[float]] = defaultdict(
            lambda: deque(maxlen=AVERAGED_FRAMES)
        )
        self._points: dict[str, int] = {}
        self._scores: dict[str, AgentScore] = {}
        self._drops = DropCounts()
        self._dropped: dict[tuple[str, str], int] = {}

    @property
    def is_filled(self) -> bool:
        """Whether all parts of the view have data."""
        told = (told for one in self._junctions for told in (one.counts, one.state))
        is_told = self.progress is not None and all(one is not None for one in told)
        return is_told and bool(self._latencies)

    @property
    def is_over(self) -> bool:
        """Whether the world has ended or is gone."""
        return self.end is not None or any(role == "sim" for role, _ in self.gone)

    def take(self, item: Envelope | Presence) -> None:
        """Adds a message or a change of presence.

        Raises:
            MessageError: its frame is implausible, or it is of one process or agent too many.
        """
        if isinstance(item, Presence):
            self._take_presence(item)
            return
        message = item.message
        self._take_plain(message)
        self._observed.take(message)
        if isinstance(message, _STAGES) or item.topic == "clock":
            self._stages.take(message)
        if isinstance(message, Tick):
            self.frame, self.sim_time_ns = message.frame, message.sim_time_ns
            self._ticked_ns = item.received_ns
            self._take_latencies()
        elif isinstance(message, Metrics):
            self._take_metrics(message)

    def agents(self) -> list[AgentRow]:
        """Returns the agents that upload now, the fastest first."""
        rates = self._rates.mbps(self.sim_time_ns)
        self._points = {agent: self._points.get(agent, 0) for agent in rates}
        rows = [
            AgentRow(agent, self._points[agent], mbps, *_score_of(self._scores.get(agent)))
            for agent, mbps in rates.items()
        ]
        return sorted(rows, key=lambda row: (-row.mbps, row.agent))

    def stages(self) -> list[StageRow]:
        """Returns latency by group of stages, end to end last; none before a complete frame."""
        if not self._latencies:
            return []
        newest = self._latencies[-1]
        rows = [
            StageRow(
                name, newest.groups_ms[name], _mean([a.groups_ms[name] for a in self._latencies])
            )
            for name in GROUPS
        ]
        whole = _mean([a.end_to_end_ms for a in self._latencies])
        return [*rows, StageRow("end to end", newest.end_to_end_ms, whole)]

    def lanes(self, side: str) -> list[LaneRow]:
        """Returns the junction's lanes "upstream" or "downstream" with their counts."""
        told = self.junction.counts if self.junction else None
        if told is None:
            return []
        counts: Mapping[str, int] = getattr(told, side)
        stationary: Mapping[str, int] = getattr(told, f"stationary_{side}")
        seen: Mapping[str, float] = getattr(told, f"coverage_{side}")
        coasted: Mapping[str, int] = getattr(told, f"coasted_{side}")
        return [
            LaneRow(n, counts[n], stationary.get(n, 0), coasted.get(n, 0), seen.get(n))
            for n in counts
        ]

    def signal(self) -> tuple[SignalState, float] | None:
        """Returns the junction's signal state, and for how many simulated seconds it is shown."""
        if self.junction is None or self.junction.state is None:
            return None
        return self.junction.state, self.junction.unchanged_s(self.sim_time_ns)

    def phase_rows(self) -> list[PhaseRow]:
        """Returns the junction's phases with their pressures."""
        if self.junction is None:
            return []
        names = self._phases[self.junction.tls]
        known = pressures(self.junction.request, names)
        shown = self.junction.phase
        return [PhaseRow(name, n == shown, known.get(name)) for n, name in enumerate(names)]

    def regions(self) -> list[RegionRow]:
        """Returns the regions; nothing where one junction is shown."""
        if self.junction is not None:
            return []
        told = self.progress.regions if self.progress else {}
        return [
            RegionRow(
                region,
                len(one.junctions),
                one.frames,
                one.incomplete,
                one.agents,
                told[region].mbps if region in told else None,
                _mean([*times]) if (times := self._region_latencies.get(region)) else None,
            )
            for region, one in self._observed.regions.items()
        ]

    def junctions(self) -> list[JunctionRow]:
        """Returns the junctions by region; nothing where one is shown."""
        return [] if self.junction is not None else [self._row(one) for one in self._junctions]

    def _row(self, one: ObservedJunction) -> JunctionRow:
        return JunctionRow(
            one.tls,
            one.region,
            "" if one.phase is None else self._phases[one.tls][one.phase],
            one.state.stage if one.state else "",
            one.unchanged_s(self.sim_time_ns) if one.state else None,
            one.vehicles,
            one.queued,
            one.coverage,
        )

    def alerts(self, now_ns: int) -> list[str]:
        """Returns current alerts, by the monotonic clock, the gravest first."""
        still_ns = now_ns - self._ticked_ns
        found = [f"no frame for {still_ns / 1e9:.0f} s"] if self._is_still(still_ns) else []
        found += [f"{role} {name} is gone" for role, name in sorted(self.gone) if not self.end]
        found += self._incomplete()
        found += [
            f"{agent} is excluded (score {score.score:.2f})"
            for agent, score in sorted(self._scores.items())
            if not score.trusted
        ]
        drops = sorted(self._dropped.items(), key=lambda one: (-one[1], one[0]))
        found += [f"{process} dropped {n} × {reason}" for (process, reason), n in drops if n]
        return found[:MAX_ALERTS]

    def _incomplete(self) -> list[str]:
        """Returns a line for each region with incomplete frames, with its name if one of several.

        Where one junction is shown, of its region alone.
        """
        found = []
        for region, one in self._regions.items():
            if missing := one.complete.count(False):
                name = f"{region}: " if self.junction is None else ""
                found.append(
                    f"{name}{missing} of the last {len(one.complete)} frames incomplete "
                    f"({one.incomplete} since this began)"
                )
        return found

    def _is_still(self, for_ns: int) -> bool:
        return self.frame >= 0 and not self.is_over and for_ns >= STILL_NS

    def _take_presence(self, presence: Presence) -> None:
        who = (presence.role, presence.id)
        if presence.alive:
            known = who in self.present or who in self.gone
            if known or len(self.present) + len(self.gone) < MAX_RATED_AGENTS:
                self.present.setdefault(who, set()).add(presence.bus)
                self.gone.discard(who)
        elif who in self.present:  # a bus whose host died is missed by all who are still there
            self.present[who].discard(presence.bus)
            if not self.present[who]:
                del self.present[who]
                self.gone.add(who)

    def _take_plain(self, message: Message) -> None:
        match message:
            case Progress():
                self.progress = message
            case End():
                self.end = message

    def _take_latencies(self) -> None:
        for frame in self._stages.latencies():
            for region, latency in frame.items():
                self._region_latencies[region].append(latency.end_to_end_ms)
            if known := {name: one for name, one in frame.items() if name in self._regions}:
                self._latencies.append(slowest(known))

    def _take_metrics(self, metrics: Metrics) -> None:
        metrics = uploads_to(metrics, self._regions)
        self._rates.take(metrics)
        sent: dict[str, int] = {}
        for upload in metrics.uploads:
            sent[upload.agent] = sent.get(upload.agent, 0) + upload.points
        self._points |= sent
        for score in metrics.scores:
            if score.agent in self._scores or len(self._scores) < MAX_RATED_AGENTS:
                self._scores[score.agent] = score
        self._drops.received(metrics.process, metrics.drops)
        self._dropped |= {(r.process, r.reason): r.times for r in self._drops.take_changed()}


def _score_of(score: AgentScore | None) -> tuple[float, bool]:
    return (1.0, True) if score is None else (score.score, score.trusted)


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
