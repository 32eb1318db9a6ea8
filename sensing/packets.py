"""Rays to and from Embree's packets: the compiled loop around its C function."""

# ruff: noqa: ANN401 - what Numba's compiler hands over has no type of its own

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from perception.arrays import Floats32, Ints32

PACKET = 16
_ORIGIN, _NEAR, _DIRECTION, _TIME, _FAR, _MASK, _ID, _FLAGS, _HIT = 0, 3, 4, 7, 8, 9, 10, 11, 17


@intrinsic
def _call(_typing: Any, where: Any) -> Any:  # pragma: no cover - runs in Numba's compiler
    """Calls the C function at `where[0]` with the four addresses that follow."""

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        words = [builder.extract_value(arguments[0], n) for n in range(5)]
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64)] * 4)
        builder.call(builder.inttoptr(words[0], kind.as_pointer()), words[1:])
        return context.get_dummy_value()

    return types.void(where), generate


@njit(
    "void(int64[::1], int32[::1], float32[:,::1], float32[:,::1], float32[:,::1], float32[::1])",
    cache=True,
)
def cast_packets(
    where: npt.NDArray[np.int64],
    active: Ints32,
    packet: Floats32,
    origins: Floats32,
    directions: Floats32,
    limits: Floats32,
) -> None:
    """Lowers each limit to where its ray first hits.

    Args:
        where: (5,) addresses of `rtcIntersect16`, `active`, the scene, `packet`, the arguments.
        active: (16,) aligned; overwritten.
        packet: (32, 16) aligned, an RTCRayHit16; overwritten.
        origins: (3, N or more), or (3, 1) for all.
        directions: (3, N or more).
        limits: (N,), overwritten.
    """
    count = len(limits)
    address = (where[0], where[1], where[2], where[3], where[4])
    bits = packet.view(np.int32)
    together = origins.shape[1] == 1
    for first in range(0, count, PACKET):
        size = min(PACKET, count - first)
        for lane in range(size):
            ray = first + lane
            start = 0 if together else ray
            for axis in range(3):
                packet[_ORIGIN + axis, lane] = origins[axis, start]
                packet[_DIRECTION + axis, lane] = directions[axis, ray]
            packet[_FAR, lane] = limits[ray]
        for lane in range(PACKET):
            active[lane] = -1 if lane < size else 0
            packet[_NEAR, lane] = 0.0
            packet[_TIME, lane] = 0.0
            bits[_MASK, lane] = -1
            bits[_ID, lane] = 0
            bits[_FLAGS, lane] = 0
            bits[_HIT:, lane] = -1
        _call(address)
        for lane in range(size):
            limits[first + lane] = packet[_FAR, lane]
