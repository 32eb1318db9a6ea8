"""Anchors, and boxes written as what is left between them and an anchor (Lang et al. 2019)."""

from __future__ import annotations

import numpy as np

from perception.arrays import Floats, Floats32, Ints
from perception.pillars.config import ANCHOR_YAWS, STRIDE, PillarsConfig
from perception.pillars.voxels import Window


def middle_of(place: Ints, window: Window, config: PillarsConfig) -> Floats:
    """Returns the middles x, y (K, 2) of output cells, numbered along x first."""
    side = window.cells // STRIDE
    column, row = place % side, place // side
    return window.low + (np.stack([column, row], -1) + 0.5) * STRIDE * config.cell_m


def terms_of(boxes: Floats, middle: Floats, kind: Ints, config: PillarsConfig) -> Floats32:
    """Writes boxes (K, 7), z over the road, as terms (K, 7) of anchors at middles (K, 2).

    `kind` (K,) is the anchor's direction: 0 along x, 1 along y. The yaw's term is the angle to the
    anchor within a quarter turn either way: a box has no front.
    """
    length_m, width_m, height_m = config.anchor_m
    diagonal_m = np.hypot(length_m, width_m)
    off = (boxes[:, :2] - middle) / diagonal_m
    rise = (boxes[:, 2] - config.middle_m) / height_m
    sizes = np.log(boxes[:, 3:6] / [length_m, width_m, height_m])
    turn = boxes[:, 6] - kind * (np.pi / ANCHOR_YAWS)
    turn = (turn + np.pi / 2) % np.pi - np.pi / 2
    return np.column_stack([off, rise, sizes, turn]).astype(np.float32)


def boxes_of(terms: Floats32, middle: Floats, kind: Ints, config: PillarsConfig) -> Floats:
    """Reads boxes (K, 7), z over the road, from terms (K, 7); see `terms_of`."""
    length_m, width_m, height_m = config.anchor_m
    diagonal_m = np.hypot(length_m, width_m)
    terms = terms.astype(np.float64)
    xy = middle + terms[:, :2] * diagonal_m
    z = config.middle_m + terms[:, 2] * height_m
    sizes = np.exp(np.clip(terms[:, 3:6], -2, 2)) * [length_m, width_m, height_m]
    yaw = terms[:, 6] + kind * (np.pi / ANCHOR_YAWS)
    return np.column_stack([xy, z, sizes, yaw])
