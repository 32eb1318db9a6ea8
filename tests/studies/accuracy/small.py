"""Scenarios whose LiDARs have few beams."""

from typing import Any

from cpnet.scenario import load


def small(**overrides: Any) -> dict[str, Any]:
    """The built-in junction with every key, seen by 24 x 900 beams."""
    few: dict[str, Any] = {"traffic.step_s": 0.5, "frame_period_s": 0.5}
    for kind in ("roadside", "vehicle"):
        few |= {f"lidar.{kind}.channels": 24, f"lidar.{kind}.points_per_second": 216_000}
    return load("t_junction", few | overrides).model_dump(mode="json")
