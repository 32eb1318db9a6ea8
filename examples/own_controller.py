"""A controller of one's own, a plain function, beside max pressure and the net's fixed plan.

    python examples/own_controller.py --duration 300 --seeds 1 2 3

The function is given what perception knows of a frame and says which green it wants. The cabinet
keeps minimum green, yellow and all-red, whatever is asked.
"""

from __future__ import annotations

import argparse
from statistics import mean

import cpnet
from protocol.roadmap import Signal
from signal_controller.observation import Observation

WORTH_S = 8.0  # of driving time: a vehicle so far from the stop bar counts nothing


def soonest(observation: Observation, signal: Signal) -> int:
    """Returns the green before which most vehicles stand or will soon arrive."""
    vehicles = observation.vehicles  # tracks: lane, distance to the stop bar in m, speed in m/s
    if vehicles is None or not len(vehicles.lanes):
        return 0
    weights = dict.fromkeys((link.from_lane for link in signal.links), 0.0)
    for lane, distance_m, speed_mps in zip(
        vehicles.lanes, vehicles.distances_m, vehicles.speeds_mps, strict=True
    ):
        if lane in weights and distance_m >= 0:
            speed = speed_mps if speed_mps > 1 else 14.0  # who stands is served as if he drove
            weights[lane] += max(0.0, 1 - distance_m / speed / WORTH_S)
    shown = observation.shown.green if observation.shown is not None else ""
    worth = []
    for green in signal.greens:
        opened = {link.from_lane for link in signal.links if green[link.index] in "Gg"}
        stays = 1.3 if green == shown else 1.0  # a change costs yellow and all-red
        worth.append(stays * sum(weights[lane] for lane in opened))
    return worth.index(max(worth))


def main() -> None:
    """Prints the delay that each policy leaves, mean over seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--duration", type=float, default=300.0, help="simulated seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--channels", type=int, default=64, help="layers of every LiDAR")
    options = parser.parse_args()
    lidar = {"channels": options.channels}
    scenario = {
        "duration_s": options.duration,
        "frame_period_s": 1.0,
        "traffic": {"cav_rate": 0.2, "step_s": 0.5},
        "lidar": {"vehicle": lidar, "roadside": lidar},
    }
    policies = {
        "soonest": {"controller": soonest},
        "max_pressure": {"signal": {"policy": "max_pressure"}},
        "fixed": {"signal": {"policy": "fixed"}},
    }
    for name, settings in policies.items():
        runs = [cpnet.run(scenario, seed=seed, **settings) for seed in options.seeds]
        delays_s = [run.trips["time_loss_s"].mean() for run in runs]
        print(f"{name:13} {mean(delays_s):6.2f} s a vehicle")


if __name__ == "__main__":
    main()
