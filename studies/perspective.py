"""The junction as from a crane: a pinhole camera over points, lanes and boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from protocol.roadmap import RoadMap
from studies import palette
from studies.shapes import Floats, borders, corners, stands_out
from studies.snapshot import Boxes, Snapshot

_NEAR_M = 6.0
_EDGES = (
    (0, 1),
    (1, 2),
    (2, 3),
    (3, 0),
    (4, 5),
    (5, 6),
    (6, 7),
    (7, 4),
    (0, 4),
    (1, 5),
    (2, 6),
    (3, 7),
)


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera. `rotation` rows are right, up and ahead in the map frame."""

    place_m: Floats
    rotation: Floats

    @classmethod
    def towards(cls, target_m: Floats, azimuth_rad: float, back_m: float, up_m: float) -> Camera:
        """Stands `back_m` behind the target, looking along the azimuth, `up_m` above it."""
        level = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
        place = target_m - back_m * level + np.array([0, 0, up_m])
        ahead = (target_m - place) / np.linalg.norm(target_m - place)
        right = np.cross(ahead, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        return cls(place, np.stack([right, np.cross(right, ahead), ahead]))

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Returns picture coordinates (N, 2), in focal lengths, and depths (N,) in m."""
        seen = (points - self.place_m) @ self.rotation.T
        depth = seen[:, 2]
        return seen[:, :2] / np.maximum(depth, _NEAR_M)[:, None], depth


def view_azimuth(road_map: RoadMap) -> float:
    """Returns where to look, in rad: towards the arms, so that a T's stem leads away."""
    centre = np.array(road_map.centre[:2])
    ends = [
        road_map.by_id[n].points[0, :2] - centre for n in road_map.incoming if n in road_map.by_id
    ]
    edges = {tuple(np.round(end / max(np.linalg.norm(end), 1e-9), 1)) for end in ends}
    x, y = np.sum([*edges, (0.0, 0.02)], axis=0)
    return float(np.arctan2(y, x))


def draw_perspective(axes: Axes, snapshot: Snapshot, colours: dict[str, str]) -> None:
    """Draws the snapshot; the axes keep the limits that they were given."""
    target = np.array(snapshot.road_map.centre)
    camera = Camera.towards(target, view_azimuth(snapshot.road_map) - 0.35, 46.0, 27.0)
    axes.axis("off")
    _draw_road(axes, snapshot.road_map, camera)
    for cloud in snapshot.clouds:
        _draw_points(axes, cloud.points, camera, colours[cloud.agent])
    _draw_boxes(axes, snapshot.truth, camera, [palette.TRUTH] * len(snapshot.truth.sources), 0.5, 0)
    edges = [colours.get(source, palette.BOX) for source in snapshot.detections.sources]
    _draw_boxes(axes, snapshot.detections, camera, edges, 1.3, 0.14)


def _draw_road(axes: Axes, road_map: RoadMap, camera: Camera) -> None:
    outlines = []
    for lane in road_map.lanes:
        left, right = borders(lane)
        steps = np.linspace(0, 1, 120)
        own = np.linspace(0, 1, len(left))
        sides = [
            np.column_stack([np.interp(steps, own, side[:, i]) for i in range(3)])
            for side in (left, right[::-1])
        ]
        places, depth = camera.project(np.concatenate(sides))
        if (depth > _NEAR_M).any():
            outlines.append(places[depth > _NEAR_M])
    axes.add_collection(PolyCollection(outlines, facecolors=palette.ASPHALT, zorder=1))


def _draw_points(axes: Axes, points: Floats, camera: Camera, colour: str) -> None:
    places, depth = camera.project(points)
    high = stands_out(points)
    shown = (depth > _NEAR_M) & (np.abs(places).max(axis=1) < 1.2)
    for part, scale, alpha in ((~high, 35.0, 0.28), (high, 75.0, 0.75)):
        chosen = shown & part
        sizes = np.clip(scale / depth[chosen], 0.1, 3.0)
        axes.scatter(*places[chosen].T, s=sizes, color=colour, alpha=alpha, linewidths=0, zorder=3)


def _draw_boxes(
    axes: Axes, boxes: Boxes, camera: Camera, edges: list[str], width: float, fill: float
) -> None:
    if not len(boxes.values):
        return
    solid = corners(boxes.values)
    places, depth = camera.project(solid.reshape(-1, 3))
    places, depth = places.reshape(-1, 8, 2), depth.reshape(-1, 8)
    for place, near, colour in zip(places, depth.min(axis=1), edges, strict=True):
        if near <= _NEAR_M:
            continue
        lines = [place[list(edge)] for edge in _EDGES]
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=width, zorder=6))
        if fill:
            top = PolyCollection([place[4:]], facecolors=colour, alpha=fill, zorder=5)
            axes.add_collection(top)
