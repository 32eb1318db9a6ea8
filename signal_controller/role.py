"""The signal role: hears lane counts and the signal's state, says which green it wants."""

from __future__ import annotations

import time

from protocol.inbox import Envelope, Presence
from protocol.messages import LaneCounts, Metrics, SignalRequest, SignalState, Span
from protocol.process import Context
from signal_controller.config import SignalConfig
from signal_controller.policies import Decision, fixed, max_pressure


class SignalRole:
    """Answers each frame's counts with one request.

    Counts and states come from two processes, in any order. In lockstep the counts of a frame wait
    for the state of the same frame, so that a run repeats exactly; in realtime the newest will do.
    """

    def __init__(self, context: Context) -> None:
        scenario = context.setup.scenario
        self._context = context
        self._signal = context.setup.road_map.signal
        self._config = SignalConfig.model_validate(scenario["signal"])
        self._lockstep = scenario["mode"] == "lockstep"
        self._shown: SignalState | None = None
        self._counts: LaneCounts | None = None
        self._decided = -1
        self._late = 0

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
                newest = max(self._decided, self._counts.frame if self._counts else -1)
                self._late += counts.frame <= newest
                if counts.frame > newest:
                    self._counts = counts
            case SignalState() as shown if not self._shown or shown.frame > self._shown.frame:
                self._shown = shown

    def poll(self) -> None:
        """Decides as soon as all that the decision needs is there."""
        counts = self._counts
        if counts is None:
            return
        if self._lockstep and (self._shown is None or self._shown.frame < counts.frame):
            return
        self._counts = None
        self._decided = counts.frame
        start_ns = time.monotonic_ns()
        decision = self._decide(counts)
        self._publish(counts, decision, start_ns)

    def close(self) -> None:
        """Holds nothing of its own."""

    def _decide(self, counts: LaneCounts) -> Decision:
        if self._config.policy == "fixed":
            return fixed(self._signal, counts.sim_time_ns)
        return max_pressure(self._signal, counts, self._shown)

    def _publish(self, counts: LaneCounts, decision: Decision, start_ns: int) -> None:
        request = SignalRequest(
            frame=counts.frame,
            sim_time_ns=counts.sim_time_ns,
            tls=self._signal.tls,
            state=decision.state,
            policy=self._config.policy,
            pressures=decision.pressures,
            delay_sim_ns=counts.delay_sim_ns,
        )
        self._context.v2x.publish("request", request, tls=self._signal.tls)
        drops = dict(self._context.inbox.drops)
        if self._late:
            drops["late"] = self._late
        metrics = Metrics(
            process=self._context.id,
            frame=counts.frame,
            sim_time_ns=counts.sim_time_ns,
            spans=[Span(stage="decide", start_ns=start_ns, end_ns=time.monotonic_ns())],
            drops=drops,
        )
        self._context.world.publish("metrics", metrics, process=self._context.id)
