"""Kerbs and the pavements behind them, along the road's edges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.geometry import Floats
from sensing.config import SceneConfig
from sensing.mesh import TriangleMesh, merge, strip
from sensing.road import Edge, RoadArea
from sensing.terrain import Terrain

_WIDTHS = (1.0, 0.5, 0.1)  # of the pavement's, tried in turn where another lane is near
_SLOPE_M = 0.4  # the pavement falls to the ground over this width
_KERB_SUNK_M = 0.15  # surfaces end this far under the ground, so that no ray slips through


def kerbs(
    edges: Sequence[Edge], terrain: Terrain, road: RoadArea, config: SceneConfig
) -> TriangleMesh:
    """Returns kerbs with pavements; empty where their height is 0."""
    if config.kerb_height_m == 0:
        return merge([])
    return merge(_kerb(edge, terrain, _widths(edge, road, config), config) for edge in edges)


def _widths(edge: Edge, road: RoadArea, config: SceneConfig) -> Floats:
    """Returns a width (K,) for each section: the widest that stays off the road."""
    widths = np.zeros(len(edge.points))
    for share in reversed(_WIDTHS):
        width_m = config.sidewalk_width_m * share
        far = edge.points + edge.outward * (width_m + _SLOPE_M)
        widths[road.clearance_m(far) > 0] = width_m
    return widths


def _kerb(edge: Edge, terrain: Terrain, widths: Floats, config: SceneConfig) -> TriangleMesh:
    """Sweeps the profile: up at the edge, along the pavement, down behind it."""
    wide = widths > 0
    if np.count_nonzero(wide) < 2:
        return merge([])
    points, outward, widths = edge.points[wide], edge.outward[wide], widths[wide]
    rise_m = config.kerb_height_m
    profile = (
        (np.zeros_like(widths), -_KERB_SUNK_M),
        (np.zeros_like(widths), rise_m),
        (widths, rise_m),
        (widths + _SLOPE_M, -_KERB_SUNK_M),
    )
    sections = np.empty((len(points), len(profile), 3))
    for k, (offset, height_m) in enumerate(profile):
        xy = points + outward * offset[:, None]
        sections[:, k, :2] = xy
        sections[:, k, 2] = terrain.height_m(xy) + height_m
    return strip(sections)
