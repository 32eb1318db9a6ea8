"""An agent's part of the scene: which borders of a plan's power diagram a place lies within.

All agents of a plan compare the same numbers in the same way, so that every place has exactly one
owner at the plain borders, however the numbers are rounded. See `protocol.messages.Plan`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]

TIGHT, PLAIN, WIDE, BEYOND = 0, 1, 2, 3
NOT_SENT = 255


def cut(xy: Floats32, chunk: Bytes, sites: Floats, weights_m2: Floats, own: int) -> None:
    """Sets chunks (B,) to the tightest border that each place (B, 2) lies within, else `BEYOND`.

    Beams that are `NOT_SENT` stay so. `own` is the agent's index into sites (N, 2) and weights
    (N, 3: tight, plain, wide). Ties go to the agent with the lower index.
    """
    _cut(
        xy,
        chunk,
        np.ascontiguousarray(sites, np.float64),
        np.ascontiguousarray(weights_m2, np.float64),
        own,
    )


@njit("boolean(float64, float64, boolean)", cache=True)
def _owns(own: float, other: float, comes_first: bool) -> bool:
    return bool(own < other or (own == other and comes_first))


@njit(
    "void(float32[:,::1], uint8[::1], Array(float64, 2, 'C', readonly=True), "
    "Array(float64, 2, 'C', readonly=True), int64)",
    cache=True,
)
def _cut(xy: Floats32, chunk: Bytes, sites: Floats, weights_m2: Floats, own: int) -> None:
    own_tight, own_plain, own_wide = weights_m2[own]
    for beam in range(chunk.size):
        if chunk[beam] == NOT_SENT:
            continue
        x, y = np.float64(xy[beam, 0]), np.float64(xy[beam, 1])
        dx, dy = x - sites[own, 0], y - sites[own, 1]
        near = dx * dx + dy * dy
        border = TIGHT
        for other in range(sites.shape[0]):
            if other == own:
                continue
            dx, dy = x - sites[other, 0], y - sites[other, 1]
            far = dx * dx + dy * dy
            # Exactly one of two agents owns a place: what one says at its tight border, the other
            # denies at its wide one.
            if _owns(near - own_tight, far - weights_m2[other, 2], own < other):
                continue
            border = max(border, PLAIN)
            if _owns(near - own_plain, far - weights_m2[other, 1], own < other):
                continue
            border = max(border, WIDE)
            if not _owns(near - own_wide, far - weights_m2[other, 0], own < other):
                border = BEYOND
                break
        chunk[beam] = border
