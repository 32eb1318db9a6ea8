"""What the terminal shows: messages become rows."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from protocol.inbox import Envelope, Presence
from protocol.messages import (
    AgentScore,
    End,
    LaneCounts,
    Message,
    Metrics,
    Progress,
    Setup,
    SignalRequest,
    SignalState,
    Tick,
)
from protocol.topics import BusName
from recording.losses import DropCounts
from viewer.scene import phase_names, pressures
from viewer.stages import GROUPS, MAX_RATED_AGENTS, FrameLatency, Rates, Stages

BOARD_TOPICS = frozenset(
    {"tick", "metrics", "clock", "progress", "end", "state", "request", "lanes"}
)  # no scans: they are what is heavy
AVERAGED_FRAMES = 50
MAX_ALERTS = 64
STILL_NS = 3_000_000_000
_STAGES = (Tick, Metrics, LaneCounts)


@dataclass(frozen=True, slots=True)
class AgentRow:
    """An agent that uploads; `score` is how far the edge trusts it, 0 to 1."""

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
    """A lane's counts; `seen` is the share of it within sight, None where nobody can know."""

    lane: str
    vehicles: int
    queued: int
    seen: float | None


@dataclass(frozen=True, slots=True)
class PhaseRow:
    """A phase of the signal; `is_shown` if it is green, or what a change leads to."""

    phase: str
    is_shown: bool
    pressure: float | None


@dataclass(slots=True)
class _Shown:
    state: SignalState
    since_ns: int


@dataclass(slots=True)
class _Frames:
    """How many of the newest frames were incomplete."""

    complete: deque[bool] = field(default_factory=lambda: deque(maxlen=AVERAGED_FRAMES))
    incomplete: int = 0

    def take(self, counts: LaneCounts) -> None:
        self.complete.append(counts.complete)
        self.incomplete += not counts.complete


class Board:
    """Follows a run; rows are made when they are asked for."""

    def __init__(self, setup: Setup) -> None:
        period_ns = round(float(setup.scenario["frame_period_s"]) * 1e9)
        self.setup = setup
        self.signal_plan = setup.road_map.intersections[0].signal
        self.phases = phase_names(setup.road_map)
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
        self._points: dict[str, int] = {}
        self._scores: dict[str, AgentScore] = {}
        self._drops = DropCounts()
        self._dropped: dict[tuple[str, str], int] = {}
        self._shown: _Shown | None = None
        self._request: SignalRequest | None = None
        self.counts: LaneCounts | None = None
        self._frames = _Frames()

    @property
    def is_filled(self) -> bool:
        """Whether there is something of all kinds to be shown."""
        told = self.progress, self.counts, self._shown
        return all(one is not None for one in told) and bool(self._latencies)

    @property
    def is_over(self) -> bool:
        """Whether the world has ended or is gone."""
        return self.end is not None or any(role == "sim" for role, _ in self.gone)

    def take(self, item: Envelope | Presence) -> None:
        """Takes what came.

        Raises:
            MessageError: it is of a frame that cannot be, or one process or agent too many.
        """
        if isinstance(item, Presence):
            self._take_presence(item)
            return
        message = item.message
        self._take_plain(message)
        if isinstance(message, _STAGES) or item.topic == "clock":
            self._stages.take(message)
        if isinstance(message, Tick):
            self.frame, self.sim_time_ns = message.frame, message.sim_time_ns
            self._ticked_ns = item.received_ns
            self._latencies.extend(self._stages.latencies())
        elif isinstance(message, Metrics):
            self._take_metrics(message)

    def agents(self) -> list[AgentRow]:
        """Returns who uploads now, the fastest first."""
        rates = self._rates.mbps(self.sim_time_ns)
        self._points = {agent: self._points.get(agent, 0) for agent in rates}
        rows = [
            AgentRow(agent, self._points[agent], mbps, *_score_of(self._scores.get(agent)))
            for agent, mbps in rates.items()
        ]
        return sorted(rows, key=lambda row: (-row.mbps, row.agent))

    def stages(self) -> list[StageRow]:
        """Returns where the time goes, the whole way last; nothing before a frame is whole."""
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
        """Returns the lanes "upstream" or "downstream" with their counts."""
        if self.counts is None:
            return []
        counts: Mapping[str, int] = getattr(self.counts, side)
        stationary: Mapping[str, int] = getattr(self.counts, f"stationary_{side}")
        seen: Mapping[str, float] = getattr(self.counts, f"coverage_{side}")
        return [LaneRow(n, counts[n], stationary.get(n, 0), seen.get(n)) for n in counts]

    def signal(self) -> tuple[SignalState, float] | None:
        """Returns what the signal shows, and for how many simulated seconds so."""
        if self._shown is None:
            return None
        since_s = max(0, self.sim_time_ns - self._shown.since_ns) / 1e9
        return self._shown.state, since_s

    def phase_rows(self) -> list[PhaseRow]:
        """Returns the phases with their pressures."""
        known = pressures(self._request, self.phases)
        greens = self.signal_plan.greens
        shown = self._shown.state.green if self._shown else ""
        return [
            PhaseRow(name, green == shown, known.get(name))
            for name, green in zip(self.phases, greens, strict=True)
        ]

    def alerts(self, now_ns: int) -> list[str]:
        """Returns what somebody should know of now, on the monotonic clock, the gravest first."""
        still_ns = now_ns - self._ticked_ns
        found = [f"no frame for {still_ns / 1e9:.0f} s"] if self._is_still(still_ns) else []
        found += [f"{role} {name} is gone" for role, name in sorted(self.gone) if not self.end]
        recent = self._frames.complete
        if missing := recent.count(False):
            found.append(
                f"{missing} of the last {len(recent)} frames incomplete "
                f"({self._frames.incomplete} since this began)"
            )
        found += [
            f"{agent} is excluded (score {score.score:.2f})"
            for agent, score in sorted(self._scores.items())
            if not score.trusted
        ]
        drops = sorted(self._dropped.items(), key=lambda one: (-one[1], one[0]))
        found += [f"{process} dropped {n} × {reason}" for (process, reason), n in drops if n]
        return found[:MAX_ALERTS]

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
            case LaneCounts() | SignalState() | SignalRequest():
                if message.tls == self.signal_plan.tls:  # of several signals the first is shown
                    self._take_signal(message)

    def _take_signal(self, message: LaneCounts | SignalState | SignalRequest) -> None:
        match message:
            case SignalRequest():
                self._request = message
            case LaneCounts():
                self.counts = message
                self._frames.take(message)
            case SignalState():
                before = self._shown
                goes_on = before is not None and before.state.state == message.state
                since_ns = before.since_ns if before and goes_on else message.sim_time_ns
                self._shown = _Shown(message, since_ns)

    def _take_metrics(self, metrics: Metrics) -> None:
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
