"""Draco's kd-tree, for comparison: through DracoPy, which the extra `reference` installs.

Its decoder is native code that was not made for hostile bytes. The number of points that a payload
states is checked before it is handed over, but only an edge that has DracoPy installed and accepts
that risk decodes this form.
"""

from __future__ import annotations

import math
import struct
import sys
from types import ModuleType

import numpy as np

from protocol.errors import CodecError, ConfigError
from protocol.scans import Floats32

LEVEL = 10
MAX_BITS = 30
_HEAD = struct.Struct("<5sBBBBHI")  # magic, version (2), kind, method, flags, number of points
_POINT_CLOUD = 0


def load_draco() -> ModuleType:
    """Imports DracoPy.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import DracoPy
    except ModuleNotFoundError:
        raise ConfigError(
            "Draco needs DracoPy, which is not installed (extra `reference`): "
            f"{sys.executable} -m pip install DracoPy"
        ) from None
    module: ModuleType = DracoPy
    return module


def bits_for(points: Floats32, room_m: float) -> int:
    """Returns how many bits per axis keep every point within `room_m`.

    Raises:
        CodecError: more than Draco has.
    """
    extent_m = float((points.max(axis=0) - points.min(axis=0)).max()) if len(points) else 0.0
    cells = extent_m * math.sqrt(3) / (2 * room_m)
    bits = max(1, math.ceil(math.log2(cells + 1)))
    if bits > MAX_BITS:
        raise CodecError(f"a cloud {extent_m:.1f} m wide needs {bits} bits per axis")
    return bits


def pack_draco(points: Floats32, bits: int) -> tuple[bytes, int]:
    """Returns Draco's bytes for a cloud (N, 3), and how many points they hold.

    The points come back in another order, and those that coincide come back as one.
    """
    if not len(points):
        return b"", 0
    packed: bytes = load_draco().encode(
        np.ascontiguousarray(points), quantization_bits=bits, compression_level=LEVEL
    )
    return packed, int(_HEAD.unpack_from(packed)[-1])


def unpack_draco(packed: bytes, points: int) -> Floats32:
    """Decodes Draco's bytes.

    Raises:
        CodecError: they are damaged, hold other than this many points, or DracoPy is not here.
    """
    if points == 0 and not packed:
        return np.zeros((0, 3), np.float32)
    if len(packed) < _HEAD.size:
        raise CodecError(f"Draco's part has {len(packed)} bytes")
    magic, _, _, kind, _, flags, stated = _HEAD.unpack_from(packed)
    if magic != b"DRACO" or kind != _POINT_CLOUD or flags or stated != points:
        raise CodecError(f"Draco's part states {stated} points, the scan {points}")
    try:
        found = np.asarray(load_draco().decode(packed).points, np.float32)
    except Exception as error:  # noqa: BLE001 - DracoPy raises whatever its C++ threw
        raise CodecError(f"Draco: {error}") from None
    if found.shape != (points, 3) or not np.isfinite(found).all():
        raise CodecError(f"Draco's part holds {found.shape} points, the scan claims {points}")
    return found
