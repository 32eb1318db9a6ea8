"""Ray casting with Embree, in packets of eight rays: the distance to the first triangle.

The package embreex ships Embree, but casts one ray at a time. This calls the library that it ships:
eight neighbours at once take less than half of the time. Packets of sixteen are for processors with
AVX-512: on others Embree casts them ray by ray.
"""

from __future__ import annotations

import ctypes
import weakref
from functools import cache
from importlib.metadata import files, version
from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from perception.arrays import Floats32, Ints32
from protocol.errors import ConfigError
from sensing.mesh import TriangleMesh

# ruff: noqa: ANN401 - what Numba's compiler hands over has no type of its own


PACKET = 8
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
    "void(int64[::1], int32[::1], float32[:,::1], float32[:,::1], float32[:,::1], float32[::1], "
    "int32[::1])",
    cache=True,
)
def cast_packets(
    where: npt.NDArray[np.int64],
    active: Ints32,
    packet: Floats32,
    origins: Floats32,
    directions: Floats32,
    limits: Floats32,
    faces: Ints32,
) -> None:
    """Lowers each limit to where its ray first hits, and writes which triangle is there.

    Args:
        where: (5,) addresses of `rtcIntersect8`, `active`, the scene, `packet`, the arguments.
        active: (8,) aligned; overwritten.
        packet: (32, 8) aligned, an RTCRayHit8; overwritten.
        origins: (3, N or more), or (3, 1) for all.
        directions: (3, N or more).
        limits: (N,), overwritten.
        faces: (N or more,), overwritten; means something where the limit was lowered.
    """
    count = len(limits)
    address = (where[0], where[1], where[2], where[3], where[4])
    bits = packet.view(np.int32)
    together = origins.shape[1] == 1
    for lane in range(PACKET):
        active[lane] = -1
        packet[_NEAR, lane] = 0.0
        packet[_TIME, lane] = 0.0
        bits[_MASK, lane] = -1
        bits[_ID, lane] = 0
        bits[_FLAGS, lane] = 0
    bits[_HIT:] = -1  # the triangle, and unused rows
    for first in range(0, count, PACKET):
        size = min(PACKET, count - first)
        for axis in range(3):
            for lane in range(size):
                packet[_ORIGIN + axis, lane] = origins[axis, 0 if together else first + lane]
                packet[_DIRECTION + axis, lane] = directions[axis, first + lane]
        for lane in range(size):
            packet[_FAR, lane] = limits[first + lane]
        for lane in range(size, PACKET):
            active[lane] = 0
        _call(address)
        for lane in range(size):
            limits[first + lane] = packet[_FAR, lane]
            faces[first + lane] = bits[_HIT, lane]


_TRIANGLES, _INDICES, _VERTICES = 0, 0, 1
_UINT3, _FLOAT3 = 0x5003, 0x9003
_COHERENT, _ALL_FEATURES = 1 << 16, 0xFFFFFFFF
_RAY_ROWS = 32  # RTCRayHit8 has 21 of them
_LINE_BYTES = 64

_Bytes = npt.NDArray[np.uint8]


class Caster:
    """A mesh in Embree, whose search tree is built once, here."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self._where = None
        if len(mesh.triangles) == 0:
            return
        self._vertices = np.zeros((len(mesh.vertices) + 1, 3), np.float32)  # Embree reads 16 bytes
        self._vertices[:-1] = mesh.vertices
        self._triangles = mesh.triangles
        scene = _built(self._vertices, self._triangles)
        weakref.finalize(self, _library().rtcReleaseScene, scene)
        self._packet = _aligned(_RAY_ROWS * PACKET * 4).view(np.float32).reshape(-1, PACKET)
        self._active = _aligned(PACKET * 4).view(np.int32)
        self._arguments = _aligned(_LINE_BYTES)
        self._arguments.view(np.uint32)[:2] = _COHERENT, _ALL_FEATURES
        arrays = self._packet.ctypes.data, self._arguments.ctypes.data
        cast_at = ctypes.cast(_library().rtcIntersect8, ctypes.c_void_p).value
        self._where = np.array([cast_at, self._active.ctypes.data, scene, *arrays], np.int64)

    def cast(
        self, origins: Floats32, directions: Floats32, limits: Floats32, faces: Ints32
    ) -> None:
        """Lowers each limit to where its ray first hits; a ray that misses keeps its own.

        Distances count in lengths of the direction, which need not be 1, so that they stay the
        same under any affine map of the ray.

        Args:
            origins: (3, N or more), or (3, 1) for rays that all start in one place; contiguous.
            directions: (3, N or more), contiguous.
            limits: (N,), contiguous; overwritten.
            faces: (N or more,), contiguous; gets the triangle where the limit was lowered.
        """
        if self._where is not None and len(limits):
            packet = self._active, self._packet
            cast_packets(self._where, *packet, origins, directions, limits, faces)


@cache
def _library() -> ctypes.CDLL:
    """Loads Embree and declares its functions.

    Raises:
        ConfigError: the installed embreex does not ship it.
    """
    shipped = files("embreex") or []
    paths = [path.locate() for path in shipped if "embree4" in path.name]
    if not paths:
        raise ConfigError(
            f"embreex {version('embreex')} holds no Embree library; "
            "reinstall it: pip install --force-reinstall embreex"
        )
    library = ctypes.CDLL(str(paths[0]))
    handle, whole, size = ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t
    for name, result, arguments in (
        ("rtcNewDevice", handle, [ctypes.c_char_p]),
        ("rtcGetDeviceError", whole, [handle]),
        ("rtcNewScene", handle, [handle]),
        ("rtcReleaseScene", None, [handle]),
        ("rtcNewGeometry", handle, [handle, whole]),
        ("rtcReleaseGeometry", None, [handle]),
        (
            "rtcSetSharedGeometryBuffer",
            None,
            [handle, whole, whole, whole, handle, size, size, size],
        ),
        ("rtcCommitGeometry", None, [handle]),
        ("rtcAttachGeometry", whole, [handle, handle]),
        ("rtcCommitScene", None, [handle]),
    ):
        call = getattr(library, name)
        call.restype, call.argtypes = result, arguments
    return library


@cache
def _device() -> int:
    """Makes this process's device; it builds with one thread, as processes are many."""
    return int(_library().rtcNewDevice(b"threads=1"))


def _built(vertices: Floats32, triangles: npt.NDArray[np.int32]) -> int:
    """Returns a scene of these triangles, which must outlive it.

    Raises:
        MemoryError: Embree could not build it.
    """
    embree, device = _library(), _device()
    scene, geometry = embree.rtcNewScene(device), embree.rtcNewGeometry(device, _TRIANGLES)
    for kind, form, array, count in (
        (_VERTICES, _FLOAT3, vertices, len(vertices) - 1),
        (_INDICES, _UINT3, triangles, len(triangles)),
    ):
        embree.rtcSetSharedGeometryBuffer(
            geometry, kind, 0, form, array.ctypes.data, 0, array.strides[0], count
        )
    embree.rtcCommitGeometry(geometry)
    embree.rtcAttachGeometry(scene, geometry)
    embree.rtcReleaseGeometry(geometry)  # the scene holds it
    embree.rtcCommitScene(scene)
    error = embree.rtcGetDeviceError(device)
    if error:
        raise MemoryError(f"Embree: error {error} while building {len(triangles)} triangles")
    return int(scene)


def _aligned(size: int) -> _Bytes:
    """Returns zeros that begin at a multiple of what Embree's packets need."""
    block = np.zeros(size + _LINE_BYTES, np.uint8)
    start = -block.ctypes.data % _LINE_BYTES
    return block[start : start + size]
