"""Signal policies: from counts and time to the requested green state.

The entry point of a plug-in (group `cpnet.signal_policies`) names a `PolicyMaker`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

from protocol.messages import LaneCounts, SignalRequest, SignalState
from protocol.plugins import Plugin
from protocol.roadmap import Signal
from signal_controller.config import POLICIES, SignalConfig
from signal_controller.observation import Observation, SignalSite
from signal_controller.predictive import PlannerSettings, PredictivePlanner
from signal_controller.queue_estimator import (
    Lanes,
    QueueEstimator,
    Weight,
    extrapolated,
    uncovered_lanes,
    weighted_counts,
)
from signal_controller.speed_advice import SpeedAdviser

Unseen = Literal["alike", "empty"]


@dataclass(frozen=True, slots=True)
class Decision:
    """A green state, one character per link, and the pressure of each of the signal's phases.

    `policy` is the one that decided; `unknown` are lanes whose vehicles were estimated, not
    counted. `advice` has speeds in m/s by agent, None where earlier advice ends; see
    `speed_advice`. The state is to be shown in `wait_s`, and what was requested before until then;
    the next decision replaces one that has not begun.
    """

    state: str
    pressures: list[float]
    policy: str
    unknown: tuple[str, ...] = ()
    advice: Mapping[str, float | None] = field(default_factory=dict)
    wait_s: float = 0.0

    def request(
        self,
        tls: str,
        frame: int,
        sim_time_ns: int,
        *,
        advised: int = 0,
        delay_sim_ns: int | None = None,
    ) -> SignalRequest:
        """Returns the request to a signal's cabinet, for a frame at this simulated time."""
        return SignalRequest(
            frame=frame,
            sim_time_ns=sim_time_ns,
            tls=tls,
            state=self.state,
            policy=self.policy,
            pressures=self.pressures,
            unknown=list(self.unknown),
            advised=advised,
            not_before_ns=sim_time_ns + round(self.wait_s * 1e9),
            delay_sim_ns=delay_sim_ns,
        )


def max_pressure(
    signal: Signal,
    counts: LaneCounts,
    shown: SignalState | None,
    weight: Weight = "vehicles",
    unseen: Unseen = "empty",
    estimated: Lanes | None = None,
) -> Decision:
    """Chooses the phase of highest pressure (Varaiya 2013; Chen et al. 2022).

    A tie keeps the present green, else the plan's first phase wins. While the signal changes, the
    goal of the change is kept. Before the stop bar, an `estimated` number replaces a lane's count.
    """
    greens = signal.greens
    before, behind = weighted_counts(counts, weight)
    if unseen == "alike":
        before = extrapolated(before, counts.coverage_upstream)
        behind = extrapolated(behind, counts.coverage_downstream)
    estimated = estimated or {}
    before = {**before, **estimated}
    pressures = [pressure(signal, green, before, behind) for green in greens]
    state = phase_of_highest(greens, pressures, shown)
    return Decision(state, pressures, "max_pressure", tuple(estimated))


def fixed(signal: Signal, sim_time_ns: int) -> Decision:
    """Requests the green that the net's own plan has at this time."""
    return Decision(signal.planned_green(sim_time_ns / 1e9), [], "fixed")


def fallback_plan(signal: Signal, sim_time_ns: int, unknown: Iterable[str]) -> Decision:
    """Requests the plan's green because nothing is known of any lane before the stop bar."""
    return Decision(signal.planned_green(sim_time_ns / 1e9), [], "plan", tuple(unknown))


def phase_of_highest(greens: list[str], pressures: list[float], shown: SignalState | None) -> str:
    """Returns the green of highest pressure; see `max_pressure` for ties and changes."""
    present = shown.green if shown is not None and shown.green in greens else None
    if shown is not None and present is not None and shown.stage != "green":
        return present
    highest = max(pressures)
    if present is not None and pressures[greens.index(present)] == highest:
        return present
    return greens[pressures.index(highest)]


def pressure(
    signal: Signal, green: str, upstream: Mapping[str, float], downstream: Mapping[str, float]
) -> float:
    """Returns vehicles before minus vehicles behind, over the lanes that a phase opens.

    A lane counts once, however many exits it has; behind it counts the mean over the exits that
    this phase opens to it. A lane without a count has none. A permitted green (`g`) opens nothing
    where another phase gives right of way: vehicles that wait for a gap would hold the phase that
    cannot discharge them, a gridlock.
    """
    exits: dict[str, list[str]] = {}
    greens = signal.greens
    for link in signal.links:
        is_protected = any(one[link.index] == "G" for one in greens)
        if green[link.index] in ("G" if is_protected else "Gg"):
            exits.setdefault(link.from_lane, []).append(link.to_lane)
    return sum(
        upstream.get(lane, 0) - sum(downstream.get(name, 0) for name in names) / len(names)
        for lane, names in exits.items()
    )


class SignalPolicy(Protocol):
    """Decides for one signal, frame by frame; may keep state.

    One with an attribute `needs_vehicles` that is true gets the observation's `vehicles`: a frame
    is decided on once they have arrived as well.
    """

    def decide(self, observation: Observation) -> Decision:
        """Returns the green state to request; the cabinet keeps all times between greens."""


PolicyMaker = Callable[[SignalConfig, SignalSite], SignalPolicy]
"""Makes the policy of a signal; the settings of a plug-in are `plugin` of the configuration.

A ValueError refuses the settings.
"""


def policy_of(config: SignalConfig, site: SignalSite) -> SignalPolicy:
    """Makes the policy that a configuration names, for a signal.

    Raises:
        ConfigError: the plug-in cannot be imported, refuses its settings or makes no policy.
    """
    match config.policy:
        case "fixed":
            return FixedPlan(site.signal)
        case "max_pressure":
            return HeldGreens(MaxPressure(config, site), config.hold_s)
        case "predictive":
            return Predictive(config, site)
        case name:
            plugin = POLICIES.load(name)
            made = plugin.make("decide", config, site)
            return _CheckedPolicy(plugin, made, site.signal, site.cabinet.stale_after_s)


@dataclass(frozen=True, slots=True, eq=False)
class FixedPlan:
    """The net's own plan."""

    signal: Signal

    def decide(self, observation: Observation) -> Decision:
        """See `SignalPolicy.decide`."""
        return fixed(self.signal, observation.counts.sim_time_ns)


class MaxPressure:
    """Max pressure, with estimates for lanes that no sensor covers."""

    def __init__(self, config: SignalConfig, site: SignalSite) -> None:
        self._config = config
        self._signal = site.signal
        self._estimator = QueueEstimator(site.signal, config, site.upstream_m)

    def decide(self, observation: Observation) -> Decision:
        """See `SignalPolicy.decide`."""
        counts, shown = observation.counts, observation.shown
        config, estimated = self._config, {}
        if config.unseen == "alike":
            estimate = self._estimator.take(counts, shown)
            if estimate.is_blind:
                return fallback_plan(self._signal, counts.sim_time_ns, estimate.vehicles)
            estimated = estimate.vehicles
        return max_pressure(self._signal, counts, shown, config.weight, config.unseen, estimated)


class HeldGreens:
    """Holds each green for a least time before it asks the policy again: fewer lost times."""

    def __init__(self, policy: SignalPolicy, hold_s: float) -> None:
        self._policy = policy
        self._hold_s = hold_s
        self._green, self._since_s = "", 0.0
        self.needs_vehicles = bool(getattr(policy, "needs_vehicles", False))

    def decide(self, observation: Observation) -> Decision:
        """See `SignalPolicy.decide`."""
        decision, shown = self._policy.decide(observation), observation.shown
        if shown is None or shown.stage != "green":
            self._green = ""
            return decision
        time_s = observation.counts.sim_time_ns / 1e9
        if shown.green != self._green:
            self._green, self._since_s = shown.green, time_s
        if time_s - self._since_s < self._hold_s:
            return Decision(shown.green, decision.pressures, decision.policy, decision.unknown)
        return decision


class Predictive:
    """The predictive planner, with estimates for lanes that no sensor covers.

    When nothing has been known of any lane for `estimator_timeout_s`, it requests the fixed plan.
    """

    needs_vehicles = True

    def __init__(self, config: SignalConfig, site: SignalSite) -> None:
        self._site = site
        self._timeout_s = config.estimator_timeout_s
        self.planner = PredictivePlanner(
            site,
            PlannerSettings(
                horizon_s=config.horizon_s,
                max_red_s=config.max_red_s,
                pedestrian_green_s=config.pedestrian_green_s,
                inflow_vph=config.estimator_inflow_vph,
                saturation_vph=config.estimator_saturation_vph,
            ),
        )
        self._adviser = (
            SpeedAdviser(self.planner, config.advice_min_mps) if config.speed_advice else None
        )

    def decide(self, observation: Observation) -> Decision:
        """See `SignalPolicy.decide`."""
        decision, shown = self._decide(observation), observation.shown
        if self._adviser is None:
            return decision
        if decision.policy != "predictive" or shown is None:
            return replace(decision, advice=self._adviser.release())
        time_s = observation.counts.sim_time_ns / 1e9
        return replace(decision, advice=self._adviser.advise(time_s, shown))

    def _decide(self, observation: Observation) -> Decision:
        counts, shown = observation.counts, observation.shown
        unknown = tuple(uncovered_lanes(self._site.lanes, counts.coverage_from_bar))
        if observation.vehicles is None or shown is None:
            return fallback_plan(self._site.signal, counts.sim_time_ns, unknown)
        state = self.planner.request(
            counts.sim_time_ns / 1e9, observation.vehicles, shown, counts.coverage_from_bar
        )
        if self.planner.queues.blind_s >= self._timeout_s:
            return fallback_plan(self._site.signal, counts.sim_time_ns, unknown)
        return Decision(state, [], "predictive", unknown, wait_s=self.planner.wait_s)


@dataclass(frozen=True, slots=True, eq=False)
class _CheckedPolicy:
    """Checks each decision of a plug-in."""

    plugin: Plugin
    policy: SignalPolicy
    signal: Signal
    stale_after_s: float

    @property
    def needs_vehicles(self) -> bool:
        """Whether the plug-in wants single vehicles."""
        return bool(getattr(self.policy, "needs_vehicles", False))

    def decide(self, observation: Observation) -> Decision:
        """See `SignalPolicy.decide`.

        Raises:
            ConfigError: what the plug-in returned is no decision for this signal.
        """
        decision = self.policy.decide(observation)
        if not isinstance(decision, Decision):
            raise self.plugin.wrong(f"decided a {type(decision).__name__}, must decide a Decision")
        links = len(self.signal.plan[0].state)
        if len(decision.state) != links or not set(decision.state) <= set("Ggr"):
            raise self.plugin.wrong(
                f"decided {decision.state!r:.80}, must be a G, g or r for each of {links} links"
            )
        wait_s: object = decision.wait_s
        if not isinstance(wait_s, int | float) or not 0 <= wait_s <= self.stale_after_s:
            raise self.plugin.wrong(
                f"waits {decision.wait_s!r:.80} s, must be 0 to {self.stale_after_s:g} "
                "(cabinet.stale_after_s)"
            )
        return decision
