"""Tiles of the map: squares by which bodies are published, so that no process receives all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from protocol.geometry import Floats
from protocol.messages import TileBodies

Tile = tuple[int, int]
"""Column and row: x and y of the south-west corner over the edge."""

TILE_M = 200.0
"""Edge length of a tile, m. The range of a LiDAR of 100 m meets about four tiles."""


def tiles_of(places: Floats) -> npt.NDArray[np.int32]:
    """Returns the tile (N, 2) in which each place (N, 2 or more), x, y in m, lies."""
    return np.floor(places[:, :2] / TILE_M).astype(np.int32)


def tiles_within(places: Floats, reach_m: float) -> set[Tile]:
    """Returns the tiles of which a part is nearer than `reach_m` to one of the places (N, 2)."""
    first = np.floor((places - reach_m) / TILE_M).astype(int)
    last = np.floor((places + reach_m) / TILE_M).astype(int)
    boxes = {(*low, *high) for low, high in zip(first.tolist(), last.tolist(), strict=True)}
    return {
        (column, row)
        for west, south, east, north in boxes
        for column in range(west, east + 1)
        for row in range(south, north + 1)
    }


def tile_name(tile: Tile) -> str:
    """Returns a tile's name in a key."""
    return f"{tile[0]}.{tile[1]}"


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Bodies of several tiles, sorted by id: types (N,), poses (N, 6) and speeds (N,)."""

    ids: list[str]
    types: list[str]
    poses: Floats
    speeds_mps: npt.NDArray[np.float32]


def joined(tiles: Iterable[TileBodies]) -> Bodies:
    """Returns the bodies of these tiles; of one that stands in two, the newer place."""
    parts = sorted(tiles, key=lambda tile: tile.frame)
    place = {name: n for n, name in enumerate(name for tile in parts for name in tile.ids)}
    types = [kind for tile in parts for kind in tile.types]
    ids = sorted(place)
    order = np.array([place[name] for name in ids], np.int64)
    return Bodies(
        ids=ids,
        types=[types[n] for n in order],
        poses=np.concatenate([np.zeros((0, 6)), *(tile.poses for tile in parts)])[order],
        speeds_mps=np.concatenate([_NO_SPEEDS, *(tile.speeds_mps for tile in parts)])[order],
    )


_NO_SPEEDS = np.zeros(0, np.float32)
