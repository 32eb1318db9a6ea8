"""The ground as triangles: the terrain's own cells near the road, larger ones away from it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.geometry import Floats
from sensing.mesh import TriangleMesh
from sensing.road import RoadArea
from sensing.terrain import MARGIN_M, Terrain

_BLOCK = 4  # cells along a block's side
_FINE_WITHIN_M = 60.0  # of the road

Blocks = npt.NDArray[np.int8]
_NONE, _COARSE, _FINE = 0, 1, 2


def ground(terrain: Terrain, road: RoadArea) -> TriangleMesh:
    """Returns the ground's mesh; blocks of cells that no sensor on the road sees are left out."""
    rows, columns = terrain.nodes.shape
    blocks = _levels(terrain, road, ((rows - 1) // _BLOCK, (columns - 1) // _BLOCK))
    triangles = [_fine_triangles(blocks, columns), _coarse_triangles(blocks, columns)]
    used, renamed = np.unique(np.concatenate(triangles), return_inverse=True)
    row, column = np.divmod(used, columns)
    vertices = np.column_stack(
        [
            terrain.origin[0] + column * terrain.cell_m,
            terrain.origin[1] + row * terrain.cell_m,
            terrain.nodes[row, column],
        ]
    )
    return TriangleMesh.of(vertices, renamed.reshape(-1, 3))


def _levels(terrain: Terrain, road: RoadArea, shape: tuple[int, int]) -> Blocks:
    size_m = _BLOCK * terrain.cell_m
    row, column = np.indices(shape)
    middle: Floats = terrain.origin + (np.stack([column, row], -1) + 0.5) * size_m
    clearance = road.clearance_m(middle).reshape(shape) - size_m * 0.71
    levels = np.where(clearance < _FINE_WITHIN_M, _FINE, _COARSE)
    return np.where(clearance < MARGIN_M, levels, _NONE).astype(np.int8)


def _fine_triangles(blocks: Blocks, columns: int) -> npt.NDArray[np.int64]:
    """Cells are cut from low to high x and y, as `Terrain` interpolates."""
    row, column = np.nonzero(blocks == _FINE)
    step = np.arange(_BLOCK)
    i = (row[:, None, None] * _BLOCK + step[:, None]).repeat(_BLOCK, 2).ravel()
    j = (column[:, None, None] * _BLOCK + step[None, :]).repeat(_BLOCK, 1).ravel()
    low = i * columns + j
    right, up, high = low + 1, low + columns, low + columns + 1
    return np.concatenate([np.stack([low, right, high], -1), np.stack([low, high, up], -1)])


def _coarse_triangles(blocks: Blocks, columns: int) -> npt.NDArray[np.int64]:
    """A fan from each block's middle; a side shared with a fine block takes all nodes there."""
    found: list[tuple[int, int, int]] = []
    for row, column in np.argwhere(blocks == _COARSE).tolist():
        ring = _ring(blocks, row, column)
        i, j = row * _BLOCK, column * _BLOCK
        nodes = [(i + di) * columns + j + dj for di, dj in ring]
        hub = (i + _BLOCK // 2) * columns + j + _BLOCK // 2
        found += [(hub, a, b) for a, b in zip(nodes, nodes[1:] + nodes[:1], strict=True)]
    return np.array(found, np.int64).reshape(-1, 3)


def _ring(blocks: Blocks, row: int, column: int) -> list[tuple[int, int]]:
    """Returns a block's border nodes, counter-clockwise from its low corner."""

    def is_fine(r: int, c: int) -> bool:
        within = 0 <= r < blocks.shape[0] and 0 <= c < blocks.shape[1]
        return within and int(blocks[r, c]) == _FINE

    steps = {side: 1 if is_fine(row + side[0], column + side[1]) else _BLOCK for side in _SIDES}
    south, east, north, west = (range(0, _BLOCK, steps[side]) for side in _SIDES)
    return (
        [(0, n) for n in south]
        + [(n, _BLOCK) for n in east]
        + [(_BLOCK, _BLOCK - n) for n in north]
        + [(_BLOCK - n, 0) for n in west]
    )


_SIDES = ((-1, 0), (0, 1), (1, 0), (0, -1))
