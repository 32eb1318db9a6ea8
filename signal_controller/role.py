"""The signal role: hears lane counts and the signal's state, says which green it wants."""

from __future__ import annotations

import time
from collections import Counter
from typing import TypeVar

from protocol.horizon import Horizon
from protocol.inbox import Envelope, Presence
from protocol.messages import LaneCounts, Metrics, SignalRequest, SignalState, Span
from protocol.process import Context
from signal_controller.config import SignalConfig
from signal_controller.policies import Decision, policy_of

MAX_KEPT = 8  # counts and states
Kept = TypeVar("Kept", LaneCounts, SignalState)


class SignalRole:
    """Answers each frame's counts with one request.

    Counts and states come from two processes, in any order. The counts of a frame wait for the
    state of the same frame, so that a run repeats exactly and no frame is believed on one message
    alone; in realtime, while no state was heard at all, the newest counts will do. Counts whose
    time is too far from the state's get no request.
    """

    def __init__(self, context: Context) -> None:
        scenario = context.setup.scenario
        self._context = context
        self._signal = context.setup.road_map.signal
        self._config = SignalConfig.model_validate(scenario["signal"])
        self._policy = policy_of(self._config, self._signal, scenario["edge"]["upstream_m"])
        self._lockstep = scenario["mode"] == "lockstep"
        self._horizon = Horizon()
        self._shown: dict[int, SignalState] = {}
        self._counts: dict[int, LaneCounts] = {}
        self._decided = -1
        self._drops: Counter[str] = Counter()

    @classmethod
    def build(cls, context: Context) -> SignalRole:
        """Listens and shows itself."""
        role = cls(context)
        tls = role._signal.tls
        context.v2x.subscribe("lanes", region=context.setup.scenario["region"], tls=tls)
        context.v2x.subscribe("state", tls=tls)
        context.announce("signal")
        return role

    def on(self, item: Envelope | Presence) -> None:
        """Takes counts or the signal's state; what is older than the newest is left."""
        if isinstance(item, Presence):
            return
        match item.message:
            case LaneCounts() as counts:
                self._take_counts(counts)
            case SignalState() as shown:
                self._horizon.follow(shown.frame)
                if self._is_near(shown.frame):
                    self._shown[shown.frame] = shown
                    self._bound(self._shown)

    def poll(self) -> None:
        """Decides as soon as all that the decision needs is there."""
        due = [frame for frame in self._counts if self._is_due(frame)]
        fresh = [frame for frame in due if self._is_fresh(self._counts[frame])]
        for frame in set(due) - set(fresh):
            refused = self._counts.pop(frame)
            if not fresh:
                self._publish_metrics(refused)
        if not fresh:
            return
        frame = self._decided = max(fresh)
        counts = self._counts[frame]
        if frame in self._shown:
            self._horizon.reach(frame)
        self._counts = {later: kept for later, kept in self._counts.items() if later > frame}
        start_ns = time.monotonic_ns()
        decision = self._policy.decide(counts, self._shown_at(frame))
        self._publish(counts, decision, start_ns)

    def close(self) -> None:
        """Holds nothing of its own."""

    def _take_counts(self, counts: LaneCounts) -> None:
        if counts.frame <= self._decided:
            self._drops["late"] += 1
        elif self._is_near(counts.frame):
            self._counts[counts.frame] = counts
            self._bound(self._counts)

    def _is_near(self, frame: int) -> bool:
        near = self._horizon.admits(frame)
        self._drops["far_frame"] += not near
        return near

    def _bound(self, kept: dict[int, Kept]) -> None:
        if len(kept) > MAX_KEPT:
            del kept[self._horizon.farthest(kept)]

    def _is_due(self, frame: int) -> bool:
        if not self._shown:
            return not self._lockstep
        return frame in self._shown or frame <= max(self._decided, self._horizon.newest)

    def _is_fresh(self, counts: LaneCounts) -> bool:
        """Whether counts are of the present; counts them by reason if not.

        What virtual links took is no age here: the cabinet judges that once the request is due.
        """
        shown = self._shown_at(counts.frame)
        age_ns = 0 if shown is None else shown.sim_time_ns - counts.sim_time_ns
        is_near = abs(age_ns) <= self._config.stale_after_s * 1e9
        self._drops["stale_counts" if age_ns > 0 else "future_counts"] += not is_near
        return is_near

    def _shown_at(self, frame: int) -> SignalState | None:
        """Returns the newest state that is known to be real, once a frame's counts are."""
        newest = max(frame, self._horizon.newest)
        return self._shown.get(max((n for n in self._shown if n <= newest), default=-1))

    def _publish(self, counts: LaneCounts, decision: Decision, start_ns: int) -> None:
        request = SignalRequest(
            frame=counts.frame,
            sim_time_ns=counts.sim_time_ns,
            tls=self._signal.tls,
            state=decision.state,
            policy=decision.policy,
            pressures=decision.pressures,
            unknown=list(decision.unknown),
            delay_sim_ns=counts.delay_sim_ns,
        )
        decided_ns = time.monotonic_ns()  # before it is sent: the cabinet may act at once
        self._context.v2x.publish("request", request, tls=self._signal.tls)
        span = Span(stage="decide", start_ns=start_ns, end_ns=decided_ns)
        self._publish_metrics(counts, span)

    def _publish_metrics(self, counts: LaneCounts, *spans: Span) -> None:
        drops = dict(+(Counter(self._context.inbox.drops) + self._drops))
        metrics = Metrics(
            process=self._context.id,
            frame=counts.frame,
            sim_time_ns=counts.sim_time_ns,
            spans=list(spans),
            drops=drops,
        )
        self._context.world.publish("metrics", metrics, process=self._context.id)
