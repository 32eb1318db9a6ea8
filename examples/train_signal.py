"""Trains an agent for a signal on what is perceived, for about a minute, and tests it.

    python examples/train_signal.py --seconds 60

A linear policy is searched for by the cross-entropy method, with numpy alone, on traffic of other
seeds than it is tested on. Needs the extra `rl`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from cpnet.environments import SignalEnv

Policy = Callable[[np.ndarray], int]
POPULATION, KEPT = 8, 3


def features(env: SignalEnv, observation: np.ndarray) -> np.ndarray:
    """Returns for each green (G, 4): queued, approaching, vehicles behind, whether it is shown."""
    values = dict(zip(env.junction.names, observation, strict=True))
    rows = []
    for green in env.junction.greens:
        links = [one for one in env.junction.signal.links if green[one.index] in "Gg"]
        before, behind = {one.from_lane for one in links}, {one.to_lane for one in links}
        queued = sum(values[f"queued {lane}"] for lane in before)
        vehicles = sum(values[f"vehicles {lane}"] for lane in before)
        beyond = sum(values[f"vehicles {lane}"] for lane in behind)
        rows.append([queued, vehicles - queued, beyond, 10 * values[f"green {green}"]])
    return np.array(rows)


def linear(env: SignalEnv, weights: np.ndarray) -> Policy:
    """Returns the policy that shows the green of the highest weighted features."""
    return lambda observation: int(np.argmax(features(env, observation) @ weights))


def play(env: SignalEnv, policy: Policy, seed: int) -> float:
    """Returns the mean reward of an episode."""
    observation, _ = env.reset(seed=seed)
    rewards, is_over = [], False
    while not is_over:
        observation, reward, _, is_over, _ = env.step(policy(observation))
        rewards.append(reward)
    return float(np.mean(rewards))


def train(env: SignalEnv, seconds: float, rng: np.random.Generator) -> tuple[np.ndarray, int]:
    """Returns weights (4,) after so much time, and how many episodes that were."""
    mean, std = np.zeros(4), np.ones(4)
    until_s, episodes = time.monotonic() + seconds, 0
    while True:
        seed = int(rng.integers(1_000, 2**31))  # below are those of the test
        tried, rewards = rng.normal(mean, std, (POPULATION, 4)), []
        for weights in tried:
            rewards.append(play(env, linear(env, weights), seed))
            episodes += 1
            if time.monotonic() > until_s and episodes >= POPULATION:
                return mean, episodes
        best = tried[np.argsort(rewards)[-KEPT:]]
        mean, std = best.mean(axis=0), best.std(axis=0) + 0.1


def delay_s(env: SignalEnv, policy: Policy, seeds: list[int]) -> float:
    """Returns the true delay of a vehicle, mean over episodes."""
    delays = []
    for seed in seeds:
        play(env, policy, seed)
        with env.run as run:
            delays.append(run.trips["time_loss_s"].mean())
    return float(np.mean(delays))


def main() -> None:
    """Prints the delay that random greens and the trained agent leave."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of training")
    parser.add_argument("--episode", type=float, default=120.0, help="simulated seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3], help="of the test")
    options = parser.parse_args()
    lidar = {"channels": 16, "points_per_second": 30_000}
    env = SignalEnv(
        "t_junction",
        decision_s=5.0,
        duration_s=options.episode,
        frame_period_s=1.0,
        traffic={"cav_rate": 0.0, "step_s": 0.5, "warmup_s": 30},
        lidar={"vehicle": lidar, "roadside": lidar},
        processes={"vehicle": 1},
    )
    rng = np.random.default_rng(1)
    weights, episodes = train(env, options.seconds, rng)
    chance = np.random.default_rng(2)
    phases = len(env.junction.greens)
    figures = {
        "random": delay_s(env, lambda _: int(chance.integers(phases)), options.seeds),
        "trained": delay_s(env, linear(env, weights), options.seeds),
    }
    env.close()
    print(f"{episodes} episodes, weights {np.round(weights, 2)}")
    for name, value in figures.items():
        print(f"{name:8} {value:6.2f} s a vehicle")


if __name__ == "__main__":
    main()
