"""Placement of roadside posts: beside the road, near the centre of their junction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from perception.arrays import Floats
from perception.roadway import lane_segments
from protocol.roadmap import RoadMap

HEIGHT_M = 6.0  # of a mast that carries signal heads over the road
_CLEAR_M = 1.5  # from the edge of a lane
_REACH_M = 40
_STEP_M = 1.0


def post_place(road_map: RoadMap, tls: str) -> tuple[float, float]:
    """Returns x and y of a post at a signal, from the centre of its junction, m.

    Where all is road as far as 40 m, that is the place farthest from the lanes.
    """
    steps_m = np.arange(-_REACH_M, _REACH_M + 1) * _STEP_M
    places = np.stack(np.meshgrid(steps_m, steps_m, indexing="ij"), -1).reshape(-1, 2)
    away_m = np.linalg.norm(places, axis=1)
    clear_m = _clear_m(places + np.array(road_map.by_tls[tls].centre[:2]), road_map)
    order = np.where(clear_m >= _CLEAR_M, away_m, 1e3 - clear_m)
    x_m, y_m = places[np.argmin(order)].tolist()
    return x_m, y_m


def post_mounts(road_map: RoadMap, signals: Sequence[str]) -> list[dict[str, Any]]:
    """Returns a post at each of some signals, as a scenario's `roadside_mounts`."""
    places = [post_place(road_map, tls) for tls in signals]
    return [
        {"id": f"post-{n}", "tls": tls, "x_m": x_m, "y_m": y_m, "height_m": HEIGHT_M}
        for n, (tls, (x_m, y_m)) in enumerate(zip(signals, places, strict=True))
    ]


def _clear_m(places: Floats, road_map: RoadMap) -> Floats:
    """Returns how far places (N, 2) are from the edge of the nearest lane, negative on it."""
    segments = lane_segments(road_map)
    low, high = places.min(axis=0) - _REACH_M, places.max(axis=0) + _REACH_M
    ends = np.stack([segments[:, 0:2], segments[:, 3:5]])
    is_near = ((ends.max(axis=0) >= low) & (ends.min(axis=0) <= high)).all(axis=1)
    clear_m = np.full(len(places), np.inf)
    for x0, y0, _, x1, y1, _, half_m in segments[is_near]:
        along = np.array([x1 - x0, y1 - y0])
        share = (places - (x0, y0)) @ along / max(float(along @ along), 1e-12)
        nearest = (x0, y0) + np.clip(share, 0.0, 1.0)[:, None] * along
        clear_m = np.minimum(clear_m, np.linalg.norm(places - nearest, axis=1) - half_m)
    return clear_m
