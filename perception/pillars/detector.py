"""PointPillars as a detector: windows over the points, one call of the network, doubles removed."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

import numpy as np
import torch

from perception.arrays import Floats, Floats32, Ints
from perception.config import PillarsDetection
from perception.detector import Cloud, Stage, untimed
from perception.overlap import suppress
from perception.pillars.config import FULL
from perception.pillars.cover import cover
from perception.pillars.engine import Engine, Seen
from perception.pillars.network import PointPillars
from perception.pillars.voxels import Window
from perception.pillars.weights import network_of
from perception.roadway import Roadway, merge
from perception.vehicles import Vehicles

EDGE_M = 3.0  # what lies closer to a window's edge is seen better by the next one
AT_ONCE = 8  # windows; bounds the memory that a cloud takes


class PillarsDetector:
    """Looks for vehicles in clouds placed on `roadway`."""

    def __init__(self, engine: Engine, roadway: Roadway, config: PillarsDetection) -> None:
        self._engine = engine
        self._roadway = roadway
        self._config = config

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:  # noqa: ARG002 - nothing is drawn
        """See `perception.detector.Detector.detect`."""
        with stage("detect"):
            parts = [*cloud.near, *cloud.bare]
            points, road_m = merge(parts)
            windows = cover(
                np.concatenate([np.zeros((0, 3), np.float32), *(part.lowest for part in parts)]),
                self._engine.config.cell_m,
            )
            boxes, scores = self._ask(points, points[:, 2] - road_m, windows)
            kept = suppress(boxes, scores, iou=self._config.same_iou)
            boxes, scores = boxes[kept], scores[kept]
            boxes[:, 2] += self._roadway.height_at(boxes)
            boxes[:, 6] = _headed(boxes[:, 6], self._roadway.yaw_at(boxes))
            return Vehicles.from_lidar(boxes, scores)

    def _ask(
        self, points: Floats32, height_m: Floats32, windows: list[Window]
    ) -> tuple[Floats, Floats]:
        boxes, scores = [np.zeros((0, 7))], [np.zeros(0)]
        if windows:
            shape = self._engine.config
            around = _around(windows, shape.cell_m)
            known, cells = self._engine.encode(points, height_m, around)
            standing = np.divmod(cells, around.columns)
            for part in _alike(windows):
                seen = [_seen(*standing, around, window, shape.cell_m) for window in part]
                found, score, number = self._engine.ask(
                    known, part, seen, min_score=self._config.min_score
                )
                well = _well_inside(found, [part[n] for n in number], shape.cell_m)
                boxes.append(found[well])
                scores.append(score[well])
        return np.concatenate(boxes), np.concatenate(scores)


def pillars_detector(name: str, config: PillarsDetection, roadway: Roadway) -> PillarsDetector:
    """Builds `pointpillars` or `pointpillars-full`, with the shipped weights or the user's.

    Raises:
        ConfigError: the weights cannot be used.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    engine = Engine(network_of(name, config), device, half=computes_in_half(device))
    return PillarsDetector(engine, roadway, config)


def paper_detector(config: PillarsDetection, roadway: Roadway) -> PillarsDetector:
    """Returns the paper's network as it is before training, in float32: to be timed."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = PointPillars(FULL)
    return PillarsDetector(Engine(network, torch.device("cpu"), half=False), roadway, config)


def computes_in_half(device: torch.device) -> bool:
    """Whether bfloat16 is a gain: on CPUs that have no instructions for it, it is slow."""
    known = torch.cpu.get_capabilities()
    return device.type != "cpu" or bool(known.get("avx512_bf16") or known.get("amx_bf16"))


def _around(windows: list[Window], cell_m: float) -> Window:
    """Returns a window that holds them all."""
    low = np.min([window.low for window in windows], axis=0)
    high = np.max([window.low + np.array(window.size[::-1]) * cell_m for window in windows], axis=0)
    columns, rows = (int(n) for n in np.round((high - low) / cell_m))
    return Window(low, columns, rows)


def _seen(row: Ints, column: Ints, around: Window, window: Window, cell_m: float) -> Seen:
    """Returns which pillars of the window around others stand in one of them."""
    first_column, first_row = np.round((window.low - around.low) / cell_m).astype(np.int64)
    row, column = row - first_row, column - first_column
    inside = (row >= 0) & (row < window.rows) & (column >= 0) & (column < window.columns)
    pillar = np.flatnonzero(inside)
    return Seen(pillar, row[pillar] * window.columns + column[pillar])


def _alike(windows: list[Window]) -> Iterator[list[Window]]:
    """Yields windows of one size, as many as are asked for at once."""
    windows = sorted(windows, key=lambda window: window.size)
    for _, group in groupby(windows, key=lambda window: window.size):
        alike = list(group)
        for first in range(0, len(alike), AT_ONCE):
            yield alike[first : first + AT_ONCE]


def _well_inside(boxes: Floats, windows: list[Window], cell_m: float) -> np.ndarray:
    low = np.array([window.low for window in windows]).reshape(-1, 2)
    side_m = np.array([w.size[::-1] for w in windows]).reshape(-1, 2) * cell_m
    off = boxes[:, :2] - low
    return np.asarray(((off >= EDGE_M) & (off < side_m - EDGE_M)).all(axis=1))


def _headed(yaw: Floats, road_yaw: Floats) -> Floats:
    """Turns boxes that have no front so that they head along the road."""
    off = (yaw - road_yaw + np.pi / 2) % np.pi - np.pi / 2
    return np.asarray((road_yaw + off + np.pi) % (2 * np.pi) - np.pi)
