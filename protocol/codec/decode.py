"""From bytes to a cloud."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.codec import planes
from protocol.codec.beams import open_image
from protocol.codec.draco import open_draco
from protocol.codec.payload import Form, Head, Reader, open_intensity, open_payload, unsqueeze
from protocol.codec.rings import Rings
from protocol.codec.tree import open_tree
from protocol.codec.window import Window
from protocol.errors import CodecError
from protocol.scans import Floats32, PointCloud, ScanPattern


def decode(payload: bytes | npt.NDArray[np.uint8]) -> PointCloud:
    """Reads a payload of any form; the points come back in the sensor frame.

    Raises:
        CodecError: the payload is not one, or claims a size beyond the limits.
    """
    head, reader = open_payload(payload if isinstance(payload, bytes) else payload.tobytes())
    points = _POINTS[head.form](head, reader)
    intensity = open_intensity(head, reader)
    reader.end()
    return PointCloud(points, intensity)


def _open_planes(head: Head, reader: Reader) -> Floats32:
    raw = unsqueeze(reader.section(), 2 * head.channels * head.columns)
    xyz = np.empty((head.points, 3), np.float32)
    directions = _pattern(head).directions.reshape(-1, 3)
    found = planes.unpack_ranges(raw, directions, head.columns, head.step_m, xyz)
    if found != head.points:
        raise CodecError(f"scan claims {head.points} points, holds {found}")
    return xyz


def _open_pattern(head: Head, reader: Reader) -> Floats32:
    spin, section = _pattern(head).spin, reader.section()
    if section:
        spin = Window.from_bytes(section, head.channels, head.columns).cut_spin(spin)
    return open_image(head, reader, *spin, head.points)


def _open_deltas(head: Head, reader: Reader) -> Floats32:
    raw = unsqueeze(reader.section(), 12 * head.points)
    xyz = np.empty((head.points, 3), np.float32)
    if not planes.unpack_points(raw, head.step_m, xyz):
        raise CodecError("a coordinate lies beyond the form's reach")
    return xyz


def _open_rings(head: Head, reader: Reader) -> Floats32:
    rings, misfits, edge_m = Rings.from_bytes(reader.section(), head.channels, head.columns)
    beams = head.channels * head.columns
    if not 0 <= head.points - misfits <= beams:
        raise CodecError(
            f"scan claims {head.points} points, {misfits} of them beside {beams} beams"
        )
    placed = open_image(head, reader, *rings.spin, head.points - misfits)
    return np.concatenate([placed, open_tree(reader, misfits, edge_m)])


def _open_tree(head: Head, reader: Reader) -> Floats32:
    return open_tree(reader, head.points, head.step_m)


def _open_draco(head: Head, reader: Reader) -> Floats32:
    return open_draco(reader.section(), head.points)


def _pattern(head: Head) -> ScanPattern:
    return ScanPattern(head.channels, head.columns, head.upper_fov_deg, head.lower_fov_deg)


_POINTS = {
    Form.PLANES: _open_planes,
    Form.IMAGE: _open_pattern,
    Form.DELTAS: _open_deltas,
    Form.RINGS: _open_rings,
    Form.TREE: _open_tree,
    Form.DRACO: _open_draco,
}
