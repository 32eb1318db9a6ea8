"""Reinforcement learning environments of signal control: Gymnasium and PettingZoo.

    env = cpnet.environments.SignalEnv("t_junction", traffic={"cav_rate": 0.1})
    observation, info = env.reset(seed=1)
    observation, reward, terminated, truncated, info = env.step(0)

An action is a green of the signal; the cabinet enforces minimum green, yellow and all-red, whatever
is requested. Observation and reward come from lane counts, as for any controller of cpnet: vehicles
that no sensor covers are not in them. Truth is in `info` and, after an episode, in `run`.

Importing it raises ConfigError where the extra `rl` is not installed.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from cpnet.python_api import Scenario, resolve, simulate
from protocol.errors import ConfigError
from protocol.extras import to_install
from protocol.messages import Setup
from protocol.roadmap import Intersection, Signal
from signal_controller.observation import Observation
from sim_host.setup import build_setup
from studies.run_frames import Run
from studies.simulated_frame import SimulatedFrame

try:
    import gymnasium
    from gymnasium.spaces import Box, Discrete
    from pettingzoo import ParallelEnv
except ModuleNotFoundError as error:
    raise ConfigError(f"environments need {error.name} (extra `rl`): {to_install('rl')}") from None

Values = npt.NDArray[np.float32]
MOST_VEHICLES = 255.0  # of a lane in an observation
_MOST_SEED = 2**31


class Junction:
    """One signal's part of an environment: its greens, and its observation as numbers."""

    def __init__(self, intersection: Intersection) -> None:
        self.signal = intersection.signal
        self.greens = intersection.signal.greens
        self._incoming, self._outgoing = intersection.incoming, intersection.outgoing

    @property
    def names(self) -> list[str]:
        """Names of the numbers of an observation (N,).

        Vehicles, queued vehicles and the covered share of each lane before the stop bars; vehicles
        of each lane behind the junction; then 1 for the green that is shown or coming, 0 for the
        others; last, 1 while the signal changes.
        """
        before = [
            f"{what} {lane}"
            for lane in self._incoming
            for what in ("vehicles", "queued", "coverage")
        ]
        behind = [f"vehicles {lane}" for lane in self._outgoing]
        return [*before, *behind, *(f"green {state}" for state in self.greens), "changing"]

    def space(self) -> Box:
        """Returns the space of observations."""
        high = [MOST_VEHICLES if name.startswith(("veh", "que")) else 1.0 for name in self.names]
        return Box(np.zeros(len(high), np.float32), np.array(high, np.float32), dtype=np.float32)

    def observe(self, frame: SimulatedFrame) -> Values:
        """Returns the observation (N,) of a frame, see `names`."""
        counts, shown = frame.counts[self.signal.tls], frame.signals[self.signal.tls]
        values: list[float] = []
        for lane in self._incoming:
            vehicles = counts.upstream.get(lane, 0), counts.stationary_upstream.get(lane, 0)
            values += [min(n, MOST_VEHICLES) for n in vehicles]
            values.append(min(counts.coverage_upstream.get(lane, 0.0), 1.0))
        values += [min(counts.downstream.get(n, 0), MOST_VEHICLES) for n in self._outgoing]
        values += [float(green == shown.green) for green in self.greens]
        return np.array([*values, float(shown.stage != "green")], np.float32)

    def queued(self, frame: SimulatedFrame) -> int:
        """Returns how many stationary vehicles are counted before the stop bars."""
        return sum(frame.counts[self.signal.tls].stationary_upstream.values())

    def truly_queued(self, frame: SimulatedFrame, stationary_mps: float) -> int:
        """Returns how many vehicles truly stand on the lanes of the stop bars."""
        own, truth = set(self._incoming), frame.truth
        slow = truth.speeds_mps < stationary_mps
        return sum(lane in own for lane, is_slow in zip(truth.lanes, slow, strict=True) if is_slow)


class Episodes:
    """Episodes of a scenario, each a run of its own seed; `wanted` are the requested greens."""

    def __init__(self, scenario: Scenario, decision_s: float, overrides: Mapping[str, Any]) -> None:
        self._scenario = scenario
        self._overrides = dict(overrides)
        resolved = resolve(scenario, overrides)
        frames = decision_s / resolved.frame_period_s
        if abs(frames - round(frames)) > 1e-6 or round(frames) < 1:
            raise ConfigError(
                f"decision_s is {decision_s:g}, must be a multiple of frame_period_s, "
                f"{resolved.frame_period_s:g}"
            )
        self._frames_each = round(frames)
        self.stationary_mps = resolved.edge.stationary_mps
        with tempfile.TemporaryDirectory(prefix="cpnet-env-") as folder:
            asked = resolved.model_dump(mode="json")
            asked["signal"]["policy"] = "controller"  # whoever acts, as in an episode
            setup = build_setup(asked, Path(folder))
        self.junctions = _junctions(setup)
        self.wanted = dict.fromkeys(self.junctions, 0)
        self._frames: Iterator[SimulatedFrame] | None = None
        self._folder: Path | None = None
        self.is_over = True

    def begin(self, seed: int) -> SimulatedFrame:
        """Begins an episode; returns its first frame, after the scenario's warm-up."""
        self.close()
        self._folder = Path(tempfile.mkdtemp(prefix="cpnet-env-"))
        overrides = {**self._overrides, "seed": seed}
        self._frames = simulate(
            self._scenario, controller=self._choose, out=self._folder, **overrides
        )
        self.is_over = False
        return next(self._frames)

    def check_on(self) -> None:
        """Checks that an episode is running.

        Raises:
            ConfigError: none has begun, or it is over.
        """
        if self._frames is None:
            raise ConfigError("no episode has begun: call reset() first")
        if self.is_over:
            raise ConfigError("the episode is over: call reset()")

    def advance(self) -> list[SimulatedFrame]:
        """Returns the frames until the next decision; fewer, or none, at the episode's end."""
        self.check_on()
        assert self._frames is not None
        frames: list[SimulatedFrame] = []
        for frame in self._frames:
            frames.append(frame)
            if len(frames) == self._frames_each:
                return frames
        self.is_over = True
        return frames

    def run(self) -> Run:
        """Returns the run of the episode that has ended.

        Raises:
            ConfigError: none has.
        """
        if self._folder is None or not self.is_over:
            raise ConfigError("the episode goes on: its run can be read once it is truncated")
        return Run(self._folder)

    def close(self) -> None:
        """Ends an episode and removes its run."""
        if self._frames is not None:
            cast("Any", self._frames).close()
            self._frames = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def _choose(self, _: Observation, signal: Signal) -> int:
        return self.wanted[signal.tls]


def _junctions(setup: Setup) -> dict[str, Junction]:
    return {one.tls: Junction(one) for one in setup.road_map.intersections}


def _checked(action: object, space: Discrete, tls: str) -> int:
    """Returns an action as a number.

    Raises:
        ValueError: it is no green of the signal.
    """
    if isinstance(action, bool | np.bool_) or not space.contains(action):
        raise ValueError(
            f"action {action!r:.80} of signal {tls}: must be an integer, a green from 0 to "
            f"{space.n - 1}"
        )
    return int(cast("int", action))


class SignalEnv(gymnasium.Env[Values, np.int64]):
    """A Gymnasium environment of one signal.

    The reward of a step is minus the number of counted queued vehicles, mean over its frames. An
    episode is truncated after the scenario's `duration_s`; the seed of `reset` is that of its
    traffic. `run` is the recorded run of the episode that has just ended.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own

    def __init__(
        self,
        scenario: Scenario = "t_junction",
        *,
        decision_s: float = 5.0,
        **overrides: Any,  # noqa: ANN401 - values of scenario keys
    ) -> None:
        """Prepares the scenario; for `overrides` see `cpnet.run`.

        Raises:
            ConfigError: the scenario cannot be run, or has several signals.
        """
        self._episodes = Episodes(scenario, decision_s, overrides)
        if len(self._episodes.junctions) != 1:
            raise ConfigError(
                f"SignalEnv is for one signal, the scenario has {len(self._episodes.junctions)}: "
                "take JunctionsEnv, or set junctions"
            )
        self.junction = next(iter(self._episodes.junctions.values()))
        self.observation_space = self.junction.space()
        self.action_space: Discrete = Discrete(len(self.junction.greens))
        self._last: SimulatedFrame | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Values, dict[str, Any]]:
        """Begins an episode; see `gymnasium.Env.reset`."""
        super().reset(seed=seed, options=options)
        chosen = int(self.np_random.integers(_MOST_SEED)) if seed is None else seed % _MOST_SEED
        self._last = self._episodes.begin(chosen)
        return self.junction.observe(self._last), self._info(self._last)

    def step(self, action: np.int64) -> tuple[Values, float, bool, bool, dict[str, Any]]:
        """Shows a green until the next decision; see `gymnasium.Env.step`.

        Raises:
            ValueError: the action is no green of the signal; the episode goes on without it.
            ConfigError: no episode has begun, or it is over.
        """
        self._episodes.check_on()
        tls = self.junction.signal.tls
        self._episodes.wanted[tls] = _checked(action, self.action_space, tls)
        frames = self._episodes.advance()
        self._last = frames[-1] if frames else self._last
        assert self._last is not None
        reward = -float(np.mean([self.junction.queued(one) for one in frames or [self._last]]))
        observed = self.junction.observe(self._last)
        return observed, reward, False, self._episodes.is_over, self._info(self._last)

    @property
    def run(self) -> Run:
        """The run of the episode that has ended, see `cpnet.Run`."""
        return self._episodes.run()

    def close(self) -> None:
        """Ends the episode."""
        self._episodes.close()

    def _info(self, frame: SimulatedFrame) -> dict[str, Any]:
        return _info(self.junction, frame, self._episodes.stationary_mps)


def _info(junction: Junction, frame: SimulatedFrame, stationary_mps: float) -> dict[str, Any]:
    return {
        "sim_time_s": frame.sim_time_s,
        "truly_queued": junction.truly_queued(frame, stationary_mps),
    }


class JunctionsEnv(ParallelEnv[str, Values, int]):
    """A PettingZoo parallel environment of several signals: an agent is a signal's id."""

    metadata: dict[str, Any] = {"name": "cpnet_junctions", "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario = "corridor",
        *,
        decision_s: float = 5.0,
        **overrides: Any,  # noqa: ANN401 - values of scenario keys
    ) -> None:
        """Prepares the scenario; for `overrides` see `cpnet.run`.

        Raises:
            ConfigError: the scenario cannot be run.
        """
        self._episodes = Episodes(scenario, decision_s, overrides)
        self.junctions = self._episodes.junctions
        self.possible_agents = sorted(self.junctions)
        self.agents: list[str] = []
        self.observation_spaces = {tls: one.space() for tls, one in self.junctions.items()}
        self.action_spaces = {tls: Discrete(len(one.greens)) for tls, one in self.junctions.items()}
        self._seeds = np.random.default_rng()
        self._last: SimulatedFrame | None = None

    def observation_space(self, agent: str) -> Box:
        """Returns the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        """Returns the space of an agent's actions."""
        return self.action_spaces[agent]

    def reset(
        self,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> tuple[dict[str, Values], dict[str, dict[str, Any]]]:
        """Begins an episode; see `pettingzoo.ParallelEnv.reset`."""
        if seed is not None:
            self._seeds = np.random.default_rng(seed)
        chosen = int(self._seeds.integers(_MOST_SEED)) if seed is None else seed % _MOST_SEED
        self.agents = list(self.possible_agents)
        self._last = self._episodes.begin(chosen)
        return self._observed(self._last), self._infos(self._last)

    def step(
        self, actions: dict[str, int]
    ) -> tuple[
        dict[str, Values],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Shows greens until the next decision; see `pettingzoo.ParallelEnv.step`.

        Raises:
            ValueError: an action is no green of its signal; the episode goes on without it.
            ConfigError: no episode has begun, or it is over.
        """
        self._episodes.check_on()
        self._episodes.wanted.update(self._checked(actions))
        frames = self._episodes.advance()
        self._last = frames[-1] if frames else self._last
        assert self._last is not None
        rewards = {
            tls: -float(
                np.mean([self.junctions[tls].queued(one) for one in frames or [self._last]])
            )
            for tls in self.agents
        }
        ended = dict.fromkeys(self.agents, self._episodes.is_over)
        results = (
            self._observed(self._last),
            rewards,
            dict.fromkeys(self.agents, False),
            ended,
            self._infos(self._last),
        )
        if self._episodes.is_over:
            self.agents = []
        return results

    @property
    def run(self) -> Run:
        """The run of the episode that has ended, see `cpnet.Run`."""
        return self._episodes.run()

    def close(self) -> None:
        """Ends the episode."""
        self._episodes.close()

    def _checked(self, actions: Mapping[str, object]) -> dict[str, int]:
        unknown = sorted(map(str, actions.keys() - self.action_spaces.keys()))
        if unknown:
            raise ValueError(
                f"actions of {', '.join(unknown)}: the signals are "
                f"{', '.join(self.possible_agents)}"
            )
        return {tls: _checked(one, self.action_spaces[tls], tls) for tls, one in actions.items()}

    def _observed(self, frame: SimulatedFrame) -> dict[str, Values]:
        return {tls: self.junctions[tls].observe(frame) for tls in self.agents}

    def _infos(self, frame: SimulatedFrame) -> dict[str, dict[str, Any]]:
        stationary_mps = self._episodes.stationary_mps
        return {tls: _info(self.junctions[tls], frame, stationary_mps) for tls in self.agents}
