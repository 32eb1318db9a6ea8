"""The environments pass the checkers of Gymnasium and PettingZoo, and see what cpnet sees."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("pettingzoo")

from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test

from cpnet.environments import JunctionsEnv, SignalEnv
from protocol.errors import ConfigError

LIDAR = {"model": "full", "channels": 16, "points_per_second": 30_000}
SMALL = {
    "frame_period_s": 1,
    "duration_s": 8,
    "traffic": {"warmup_s": 10, "cav_rate": 0.0, "step_s": 0.5},
    "lidar": {"vehicle": LIDAR, "roadside": LIDAR},
    "processes": {"vehicle": 1},
}


@pytest.fixture
def env():
    made = SignalEnv(decision_s=2, **SMALL)
    yield made
    made.close()


@pytest.mark.slow
def test_gymnasium_finds_no_fault(env) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)


@pytest.mark.slow
def test_pettingzoo_finds_no_fault() -> None:
    made = JunctionsEnv("corridor", **{**SMALL, "duration_s": 10})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of the checker itself
        parallel_api_test(made, num_cycles=3)
    assert len(made.possible_agents) == 5
    made.close()


def test_an_episode_is_as_long_as_the_scenario_and_can_be_read_afterwards(env) -> None:
    observed, info = env.reset(seed=4)
    assert dict(zip(env.junction.names, observed, strict=True))["changing"] in (0, 1)
    with pytest.raises(ConfigError, match="the episode goes on"):
        _ = env.run
    steps, is_over = 0, False
    while not is_over:
        _, reward, terminated, is_over, info = env.step(1)
        assert reward <= 0
        assert not terminated
        steps += 1
    assert steps == 4  # the first of eight frames was given by reset
    assert info["truly_queued"] >= 0
    with env.run as run:
        assert run.figures["frames"] == 8
        assert run.signals.filter(run.signals["green"] == env.junction.greens[1]).height > 3
    with pytest.raises(ConfigError, match=r"call reset\(\)"):
        env.step(0)


def test_a_bad_action_is_refused_and_the_episode_goes_on(env) -> None:
    with pytest.raises(ConfigError, match=r"call reset\(\) first"):
        env.step(0)
    env.reset(seed=4)
    for action in (-1, 99, 0.9, True, None, "0"):
        error_text = rf"action {action!r} of signal J: must be an integer, a green from 0 to 1"
        with pytest.raises(ValueError, match=error_text):
            env.step(action)
    for steps in range(1, 5):
        _, _, _, is_over, _ = env.step(np.int64(0))
        assert is_over == (steps == 4)


def test_bad_actions_of_several_signals_are_refused_alike() -> None:
    made = JunctionsEnv("t_junction", decision_s=2, **SMALL)
    with pytest.raises(ConfigError, match=r"call reset\(\) first"):
        made.step({"J": 0})
    made.reset(seed=4)
    for actions, error_text in (
        ({"J": 2}, "action 2 of signal J"),
        ({"K": 0}, "the signals are J"),
    ):
        with pytest.raises(ValueError, match=error_text):
            made.step(actions)
    *_, ended, _ = made.step({"J": 0})
    made.close()
    assert ended == {"J": False}


def test_actions_decide_what_is_shown(env) -> None:
    ends = []
    for action in (0, 1):
        env.reset(seed=4)
        for _ in range(3):
            observed, *_ = env.step(action)
        ends.append(dict(zip(env.junction.names, observed, strict=True)))
    for action, end in enumerate(ends):
        shown = [end[f"green {green}"] for green in env.junction.greens]
        assert shown == [float(index == action) for index in range(2)]


def test_observations_are_counts_of_perception(env) -> None:
    _, info = env.reset(seed=4)
    blind = SignalEnv(decision_s=2, **{**SMALL, "roadside_mounts": []})
    env.close()
    observed, info = blind.reset(seed=4)
    blind.close()
    vehicles = [
        value
        for name, value in zip(blind.junction.names, observed, strict=True)
        if name.startswith(("vehicles", "queued"))
    ]
    assert np.sum(vehicles) == 0
    assert info["sim_time_s"] == 10


@pytest.mark.parametrize(
    ("settings", "error_text"),
    [
        ({"decision_s": 1.5}, r"decision_s is 1\.5, must be a multiple of frame_period_s, 1"),
        ({"scenario": "corridor"}, r"SignalEnv is for one signal, the scenario has 5"),
    ],
)
def test_what_cannot_be_is_refused(settings, error_text) -> None:
    with pytest.raises(ConfigError, match=error_text):
        SignalEnv(**{**SMALL, **settings})
