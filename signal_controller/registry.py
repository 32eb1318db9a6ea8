"""The signal policies by their names.

The entry point of a plug-in (group `cpnet.signal_policies`) names a `PolicyMaker`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from protocol.messages import LaneCounts, SignalState
from protocol.plugins import Plugin
from protocol.roadmap import Signal
from signal_controller.config import POLICIES, SignalConfig
from signal_controller.policies import Decision, blind, fixed, max_pressure
from signal_controller.reckoning import Reckoning


class SignalPolicy(Protocol):
    """Decides for one signal, frame by frame; it may remember."""

    def decide(self, counts: LaneCounts, shown: SignalState | None) -> Decision:
        """Returns the green state to ask for; the cabinet keeps all times between greens.

        Args:
            counts: vehicles by lane, `edge.upstream_m` before the stop bar and
                `edge.downstream_m` behind it, with what of each lane was seen.
            shown: what the signal shows as these counts are true; None before it was ever heard.
        """


PolicyMaker = Callable[[SignalConfig, Signal, float], SignalPolicy]
"""Makes the policy of a signal; the settings of a plug-in are `plugin` of the configuration.

The last argument is `edge.upstream_m`. A ValueError says that the settings cannot be.
"""


def policy_of(config: SignalConfig, signal: Signal, upstream_m: float) -> SignalPolicy:
    """Makes the policy that a configuration names, for a signal.

    Raises:
        ConfigError: the plug-in cannot be imported, refuses its settings or makes no policy.
    """
    match config.policy:
        case "fixed":
            return Fixed(signal)
        case "max_pressure":
            return MaxPressure(config, signal, upstream_m)
        case name:
            plugin = POLICIES.load(name)
            return _Held(plugin, plugin.make("decide", config, signal, upstream_m), signal)


def check(config: SignalConfig) -> None:
    """Finds before a start what would keep a plug-in from being made.

    Raises:
        ConfigError: it cannot be imported.
    """
    if config.policy not in POLICIES.builtin:
        POLICIES.load(config.policy)


@dataclass(frozen=True, slots=True, eq=False)
class Fixed:
    """The plan that the net brings."""

    signal: Signal

    def decide(self, counts: LaneCounts, shown: SignalState | None) -> Decision:  # noqa: ARG002 - the clock alone decides
        """See `SignalPolicy.decide`."""
        return fixed(self.signal, counts.sim_time_ns)


class MaxPressure:
    """Max pressure, with what is reckoned of lanes that nobody sees."""

    def __init__(self, config: SignalConfig, signal: Signal, upstream_m: float) -> None:
        self._config = config
        self._signal = signal
        self._reckoning = Reckoning(signal, config, upstream_m)

    def decide(self, counts: LaneCounts, shown: SignalState | None) -> Decision:
        """See `SignalPolicy.decide`."""
        config, reckoned = self._config, {}
        if config.unseen == "alike":
            estimate = self._reckoning.take(counts, shown)
            if estimate.is_blind:
                return blind(self._signal, counts.sim_time_ns, estimate.vehicles)
            reckoned = estimate.vehicles
        return max_pressure(self._signal, counts, shown, config.weight, config.unseen, reckoned)


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """Holds a plug-in to what every policy promises, frame by frame."""

    plugin: Plugin
    policy: SignalPolicy
    signal: Signal

    def decide(self, counts: LaneCounts, shown: SignalState | None) -> Decision:
        """See `SignalPolicy.decide`.

        Raises:
            ConfigError: what the plug-in returned is no decision for this signal.
        """
        decision = self.policy.decide(counts, shown)
        if not isinstance(decision, Decision):
            raise self.plugin.wrong(f"decided a {type(decision).__name__}, must decide a Decision")
        links = len(self.signal.plan[0].state)
        if len(decision.state) != links or not set(decision.state) <= set("Ggr"):
            raise self.plugin.wrong(
                f"decided {decision.state!r:.80}, must be a G, g or r for each of {links} links"
            )
        return decision
