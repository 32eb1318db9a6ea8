"""The signal role: requests a green for each frame's lane counts."""

from __future__ import annotations

import time
from collections import Counter
from typing import TypeVar

from protocol.inbox import Envelope, Presence
from protocol.messages import LaneCounts, Metrics, SignalRequest, SignalState, Span
from protocol.process import Context
from protocol.sequence_window import SequenceWindow
from signal_controller.config import SignalConfig
from signal_controller.policies import Decision, policy_of

MAX_KEPT = 8  # counts and states that wait for each other: limits what others may send
Kept = TypeVar("Kept", LaneCounts, SignalState)


class SignalRole:
    """Answers each frame's counts with one request.

    Counts and states come from two processes, in any order. The counts of a frame wait for the
    state of the same frame, so that a run repeats exactly and no frame number is trusted on one
    message alone; in realtime, before the first state, the newest counts suffice. Counts whose
    time is too far from the state's get no request.
    """

    def __init__(self, context: Context) -> None:
        scenario = context.setup.scenario
        self._context = context
        self._signal = context.setup.road_map.signal
        self._config = SignalConfig.model_validate(scenario["signal"])
        self._policy = policy_of(self._config, self._signal, scenario["edge"]["upstream_m"])
        self._lockstep = scenario["mode"] == "lockstep"
        self._horizon = SequenceWindow()
        self._shown: dict[int, SignalState] = {}
        self._counts: dict[int, LaneCounts] = {}
        self._decided = -1
        self._drops: Counter[str] = Counter()

    @classmethod
    def build(cls, context: Context) -> SignalRole:
        """Subscribes and announces the role."""
        role = cls(context)
        tls = role._signal.tls
        context.v2x.subscribe("lanes", region=context.setup.scenario["region"], tls=tls)
        context.v2x.subscribe("state", tls=tls)
        context.announce("signal")
        return role

    def on(self, item: Envelope | Presence) -> None:
        """Takes counts or the signal's state; ignores what is older than the newest."""
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
        """Decides as soon as counts and state of a frame are there."""
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
        """Whether counts are recent; those that are not are counted by reason.

        Delays of virtual links are no age here: the cabinet checks them once the request is due.
        """
        shown = self._shown_at(counts.frame)
        age_ns = 0 if shown is None else shown.sim_time_ns - counts.sim_time_ns
        is_near = abs(age_ns) <= self._config.stale_after_s * 1e9
        self._drops["stale_counts" if age_ns > 0 else "future_counts"] += not is_near
        return is_near

    def _shown_at(self, frame: int) -> SignalState | None:
        """Returns the newest trusted state at the time of a frame's counts."""
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
