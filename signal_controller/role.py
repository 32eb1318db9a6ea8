"""The signal role: requests a green for each frame's observation, at each signal of a region."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from typing import TypeVar

from protocol.inbox import Envelope, Presence
from protocol.instances import region_of
from protocol.messages import (
    Detections,
    LaneCounts,
    Metrics,
    SignalState,
    Span,
    SpeedAdvice,
)
from protocol.process import Context
from protocol.sequence_window import SequenceWindow
from signal_controller.config import SignalConfig
from signal_controller.observation import CabinetTimes, LaneVehicles, Observation, SignalSite
from signal_controller.policies import Decision, SignalPolicy, policy_of

MAX_KEPT = 8  # counts and states that wait for each other: bounds received data
Kept = TypeVar("Kept", LaneCounts, SignalState, "FrameVehicles")


@dataclass(frozen=True, slots=True, eq=False)
class FrameVehicles:
    """The vehicles of a region in a frame."""

    frame: int
    sim_time_ns: int
    vehicles: LaneVehicles


class SignalDecider:
    """Decides for one signal, once for the counts of each frame.

    Counts and states come from two processes, in any order. The counts of a frame wait for the
    state of the same frame, so that a run repeats exactly and no frame number is trusted on one
    message alone; in realtime, before the first state, the newest counts suffice. A policy that
    needs single vehicles waits for those of the frame, too. Counts whose time is too far from the
    state's get no request. `drops` counts what was not used, by reason.
    """

    def __init__(
        self, policy: SignalPolicy, config: SignalConfig, drops: Counter[str], *, lockstep: bool
    ) -> None:
        self._policy = policy
        self._config = config
        self._lockstep = lockstep
        self._horizon = SequenceWindow()
        self._shown: dict[int, SignalState] = {}
        self._counts: dict[int, LaneCounts] = {}
        self._vehicles: dict[int, FrameVehicles] = {}
        self.needs_vehicles = bool(getattr(policy, "needs_vehicles", False))
        self._decided = -1
        self._drops = drops

    def take_counts(self, counts: LaneCounts) -> None:
        """Stores counts, unless those of a later frame were decided on."""
        if counts.frame <= self._decided:
            self._drops["late"] += 1
        elif self._is_near(counts.frame):
            self._counts[counts.frame] = counts
            self._bound(self._counts)

    def take_state(self, shown: SignalState) -> None:
        """Stores the signal's state."""
        self._horizon.follow(shown.frame)
        if self._is_near(shown.frame):
            self._shown[shown.frame] = shown
            self._bound(self._shown)

    def take_vehicles(self, vehicles: FrameVehicles) -> None:
        """Stores a frame's vehicles, unless a later frame was decided on."""
        if vehicles.frame <= self._decided:
            self._drops["late"] += 1
        elif self._is_near(vehicles.frame):
            self._vehicles[vehicles.frame] = vehicles
            self._bound(self._vehicles)

    def decide(self) -> tuple[LaneCounts, Decision | None] | None:
        """Returns the newest counts that are due, and the decision, None if they are not fresh.

        None as long as counts, state or vehicles of a frame are missing.
        """
        due = [frame for frame in self._counts if self._is_due(frame)]
        fresh = [frame for frame in due if self._is_fresh(self._counts[frame])]
        refused = [self._counts.pop(frame) for frame in sorted(set(due) - set(fresh))]
        if not fresh:
            return (refused[-1], None) if refused else None
        frame = self._decided = max(fresh)
        counts = self._counts[frame]
        if frame in self._shown:
            self._horizon.reach(frame)
        self._counts = {later: kept for later, kept in self._counts.items() if later > frame}
        vehicles = self._vehicles.get(frame)
        self._vehicles = {later: kept for later, kept in self._vehicles.items() if later > frame}
        observed = vehicles.vehicles if vehicles is not None else None
        observation = Observation(counts, self._shown_at(frame), observed)
        return counts, self._policy.decide(observation)

    def _is_near(self, frame: int) -> bool:
        near = self._horizon.admits(frame)
        self._drops["far_frame"] += not near
        return near

    def _bound(self, kept: dict[int, Kept]) -> None:
        if len(kept) > MAX_KEPT:
            del kept[self._horizon.farthest(kept)]

    def _is_due(self, frame: int) -> bool:
        if self.needs_vehicles and not self._has_vehicles(frame):
            return False
        if not self._shown:
            return not self._lockstep
        return frame in self._shown or frame <= max(self._decided, self._horizon.newest)

    def _has_vehicles(self, frame: int) -> bool:
        vehicles = self._vehicles.get(frame)
        return vehicles is not None and vehicles.sim_time_ns == self._counts[frame].sim_time_ns

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


class SignalRole:
    """Answers each frame's counts for each signal of a region with a request."""

    def __init__(self, context: Context) -> None:
        scenario = context.setup.scenario
        config = SignalConfig.model_validate(scenario["signal"])
        self._context = context
        self._region = region_of(context.id)
        self._advises = config.speed_advice
        self._drops: Counter[str] = Counter()
        signals = context.setup.road_map.by_tls
        self._deciders = {
            tls: SignalDecider(
                policy_of(
                    config,
                    SignalSite(
                        signals[tls].signal,
                        context.setup.road_map,
                        scenario["edge"]["upstream_m"],
                        CabinetTimes.of(scenario["cabinet"]),
                    ),
                ),
                config,
                self._drops,
                lockstep=scenario["mode"] == "lockstep",
            )
            for tls in scenario["regions"][self._region]
        }

    @classmethod
    def build(cls, context: Context) -> SignalRole:
        """Subscribes and announces the role."""
        role = cls(context)
        context.v2x.subscribe("lanes", region=role._region)
        if any(decider.needs_vehicles for decider in role._deciders.values()):
            context.v2x.subscribe("detections", region=role._region)
        for tls in role._deciders:
            context.v2x.subscribe("state", tls=tls)
        context.announce("signal")
        return role

    def on(self, item: Envelope | Presence) -> None:
        """Handles counts, vehicles or a signal's state; ignores those older than the newest."""
        if isinstance(item, Presence):
            return
        message = item.message
        if isinstance(message, Detections):
            self._take_detections(message)
            return
        if not isinstance(message, LaneCounts | SignalState):
            return
        decider = self._deciders.get(message.tls)
        if decider is None:
            self._drops["wrong_tls"] += 1
        elif isinstance(message, LaneCounts):
            decider.take_counts(message)
        else:
            decider.take_state(message)

    def _take_detections(self, detections: Detections) -> None:
        vehicles = FrameVehicles(
            detections.frame, detections.sim_time_ns, LaneVehicles.of(detections)
        )
        for decider in self._deciders.values():
            decider.take_vehicles(vehicles)

    def poll(self) -> None:
        """Decides once counts and state of a frame arrived; publishes metrics of each frame."""
        frames: dict[int, tuple[LaneCounts, list[Span]]] = {}
        for tls, decider in self._deciders.items():
            start_ns = time.monotonic_ns()
            found = decider.decide()
            if found is None:
                continue
            counts, decision = found
            _, spans = frames.setdefault(counts.frame, (counts, []))
            if decision is not None:
                spans.append(self._publish(tls, counts, decision, start_ns))
        for _, (counts, spans) in sorted(frames.items()):
            self._publish_metrics(counts, spans)

    def close(self) -> None:
        """Holds nothing of its own."""

    def _publish(self, tls: str, counts: LaneCounts, decision: Decision, start_ns: int) -> Span:
        request = decision.request(
            tls,
            counts.frame,
            counts.sim_time_ns,
            advised=len(decision.advice) if self._advises else 0,
            delay_sim_ns=counts.delay_sim_ns,
        )
        if self._advises:
            self._publish_advice(tls, counts, decision)
        decided_ns = time.monotonic_ns()  # before it is sent: the cabinet may act at once
        self._context.v2x.publish("request", request, tls=tls)
        return Span(stage="decide", agent=tls, start_ns=start_ns, end_ns=decided_ns)

    def _publish_advice(self, tls: str, counts: LaneCounts, decision: Decision) -> None:
        """Publishes a speed for each agent; the request holds their number."""
        for agent, speed_mps in sorted(decision.advice.items()):
            advice = SpeedAdvice(
                frame=counts.frame,
                sim_time_ns=counts.sim_time_ns,
                tls=tls,
                agent=agent,
                speed_mps=speed_mps,
                delay_sim_ns=counts.delay_sim_ns,
            )
            self._context.v2x.publish("advice", advice, tls=tls, agent=agent)

    def _publish_metrics(self, counts: LaneCounts, spans: list[Span]) -> None:
        drops = dict(+(Counter(self._context.inbox.drops) + self._drops))
        metrics = Metrics(
            process=self._context.id,
            frame=counts.frame,
            sim_time_ns=counts.sim_time_ns,
            spans=spans,
            drops=drops,
        )
        self._context.world.publish("metrics", metrics, process=self._context.id)
