"""The junction as from a crane: a pinhole camera over points, lanes and boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from perception.arrays import Floats
from protocol.roadmap import RoadMap
from studies import palette
from studies.outlines import borders, corners, resampled, stands_out, view_azimuth
from studies.snapshot import Boxes, Snapshot

_BACK_M, _UP_M, _AHEAD_M, _TURN_RAD = 46.0, 27.0, 8.0, -0.3
_NEAR_M = 6.0
_CLEAR_M = 28.0  # nothing nearer is drawn of the clouds: walls before the lens
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


def draw_perspective(axes: Axes, snapshot: Snapshot, colours: dict[str, str]) -> None:
    """Draws the snapshot; the axes keep the limits that they were given."""
    azimuth_rad = view_azimuth(snapshot.road_map) + _TURN_RAD
    ahead = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    target = np.array(snapshot.road_map.centre) + _AHEAD_M * ahead
    camera = Camera.towards(target, azimuth_rad, _BACK_M, _UP_M)
    _draw_road(axes, snapshot.road_map, camera)
    for cloud in snapshot.clouds:
        _draw_points(axes, cloud.points, camera, colours[cloud.agent])
    truth, detections = snapshot.truth, snapshot.detections
    _draw_boxes(axes, truth, camera, [palette.TRUTH] * len(truth.sources), 0.6)
    edges = [colours.get(source, palette.BOX) for source in detections.sources]
    _draw_boxes(axes, detections, camera, edges, 1.3)


def _draw_road(axes: Axes, road_map: RoadMap, camera: Camera) -> None:
    rings = [_ring(*borders(lane)) for lane in road_map.lanes]
    if len(road_map.junction) > 2:
        level_m = np.full((len(road_map.junction), 1), road_map.centre[2])
        rings.append(np.hstack([road_map.junction, level_m]))
    surfaces = []
    for ring in rings:
        places, depth = camera.project(ring)
        surfaces.append(places[depth > _NEAR_M])
    axes.add_collection(PolyCollection(surfaces, facecolors=palette.ASPHALT, zorder=1))
    lines = []
    for lane in road_map.lanes:
        for side in () if lane.internal else borders(lane):
            places, depth = camera.project(resampled(side))
            lines.append(places[depth > _NEAR_M])
    axes.add_collection(LineCollection(lines, colors=palette.MARKING, linewidths=0.6, zorder=2))


def _ring(left: Floats, right: Floats) -> Floats:
    return np.concatenate([resampled(left), resampled(right[::-1])])


def _draw_points(axes: Axes, points: Floats, camera: Camera, colour: str) -> None:
    places, depth = camera.project(points)
    high = stands_out(points)
    shown = (depth > _CLEAR_M) & (np.abs(places).max(axis=1) < 1.2)
    for part, scale, alpha in ((~high, 35.0, 0.28), (high, 70.0, 0.7)):
        x, y = places[shown & part].T
        sizes = np.clip(scale / depth[shown & part], 0.1, 3.0)
        axes.scatter(x, y, s=sizes, color=colour, alpha=alpha, linewidths=0, zorder=3)


def _draw_boxes(axes: Axes, boxes: Boxes, camera: Camera, edges: list[str], width: float) -> None:
    places, depth = camera.project(corners(boxes.values).reshape(-1, 3))
    seen = depth.reshape(-1, 8).min(axis=1) > _NEAR_M
    for place, colour in zip(places.reshape(-1, 8, 2)[seen], np.array(edges)[seen], strict=True):
        lines = [place[list(edge)] for edge in _EDGES]
        axes.add_collection(LineCollection(lines, colors=str(colour), linewidths=width, zorder=6))
