"""Encoding and decoding of scans and clouds, in each form of a payload."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from protocol.codec import planes
from protocol.codec.beam_origin import FRAME_ORIGIN
from protocol.codec.image_sections import Window, image_step_m, pack_image, unpack_image
from protocol.codec.lattice import lattice_edge_m
from protocol.codec.octree import pack_tree, unpack_tree
from protocol.codec.payload import (
    Form,
    Head,
    Reader,
    compress,
    decompress,
    pack_intensity,
    read_payload,
    unpack_intensity,
)
from protocol.codec.rings import RingImage, Rings, find_rings
from protocol.errors import CodecError
from protocol.limits import MAX_POINTS
from protocol.scans import (
    Floats,
    Floats32,
    PointCloud,
    Profile,
    RangeScan,
    ScanPattern,
    profile_named,
)

MIN_BOUND_M, MAX_BOUND_M = 1e-4, 10.0
_ROUNDING = 2.0**-22  # of a distance: what float32 may do to a point on both sides


# How far above a sample's ratio that of all points may lie: where the bound is fine, and coarse.
_SAMPLE_ERROR, _COARSE_ERROR = 0.06, 0.3
_TABLES = 250  # bytes by which a sample's tables may mislead


def check_bound(max_error_m: float) -> None:
    """Checks that an error bound is between 0.1 mm and 10 m.

    Raises:
        CodecError: it is not a length between 0.1 mm and 10 m.
    """
    if not (math.isfinite(max_error_m) and MIN_BOUND_M * (1 - 1e-6) <= max_error_m <= MAX_BOUND_M):
        raise CodecError(f"error bound {max_error_m} m: needs {MIN_BOUND_M} to {MAX_BOUND_M:g}")


def room_m(max_error_m: float, farthest_m: float, kind: str) -> float:
    """Returns the part of the error bound that quantisation may use: all but float32's rounding.

    Args:
        max_error_m: the bound.
        farthest_m: the largest distance or coordinate.
        kind: what it is, for the message.

    Raises:
        CodecError: float32 alone takes half of the bound.
    """
    room = max_error_m - (farthest_m + max_error_m) * _ROUNDING
    if room < max_error_m / 2:
        raise CodecError(
            f"{kind} {farthest_m:.1f} m at a bound of {max_error_m} m: float32 ends at "
            f"{max_error_m / 2 / _ROUNDING:.1f} m"
        )
    return room


def encode_scan(
    scan: RangeScan,
    max_error_m: float,
    *,
    profile: str = Profile.DEFAULT,
    intensity: bool = False,
) -> bytes:
    """Encodes a structured scan; every point moves by at most `max_error_m` along its beam.

    Args:
        scan: one revolution.
        max_error_m: the bound, 0.1 mm to 10 m.
        profile: name of a `Profile`.
        intensity: whether intensities are sent, a byte each.

    Raises:
        CodecError: a range is negative, not finite, or too far for the bound.
    """
    check_bound(max_error_m)
    chosen = profile_named(profile)
    farthest_m = float(scan.range_m.max())
    if not (np.isfinite(farthest_m) and float(scan.range_m.min()) >= 0):
        raise CodecError("a range is negative or not finite")
    room = room_m(max_error_m, farthest_m, "range")
    range_m = np.ascontiguousarray(scan.range_m, np.float32)
    if chosen is Profile.FAST:
        form, step_m = Form.PLANES, 2.0 * room
        sections, points = _pack_planes(range_m, max_error_m, step_m)
    else:
        form, step_m = Form.IMAGE, image_step_m(room)
        window = Window.around(range_m)
        image = range_m if window is None else window.cut(range_m)
        sections, points = pack_image(image, step_m)
        sections = [b"" if window is None else window.to_bytes(), *sections]
    shades = pack_intensity(scan.intensity[scan.range_m > 0], True) if intensity else []
    pattern = scan.pattern
    fov_deg = (pattern.upper_fov_deg, pattern.lower_fov_deg)
    beams = (pattern.channels, pattern.columns)
    head = Head(form, points, step_m, *beams, *fov_deg, intensity, pattern.elevations_deg)
    return head.seal(*sections, *shades)


def encode_cloud(
    cloud: PointCloud,
    max_error_m: float,
    *,
    profile: str = Profile.DEFAULT,
    intensity: bool = False,
) -> bytes:
    """Encodes an unordered cloud; every point moves by at most `max_error_m`.

    Profile `fast` keeps the order of the points; `default` does not. It takes the smaller of an
    octree and, where the rings of one spinning LiDAR are found, a range image of these.

    Args:
        cloud: in the sensor frame.
        max_error_m: the bound, 0.1 mm to 10 m.
        profile: name of a `Profile`.
        intensity: whether intensities are sent, a byte each.

    Raises:
        CodecError: a coordinate is not finite or too far away for the bound.
    """
    check_bound(max_error_m)
    chosen = profile_named(profile)
    points = np.asarray(cloud.points, np.float64).reshape(-1, 3)
    if len(points) > MAX_POINTS:
        raise CodecError(f"cloud has {len(points)} points, limit {MAX_POINTS}")
    farthest_m = float(np.abs(points).max()) if len(points) else 0.0
    if not np.isfinite(farthest_m):
        raise CodecError("a coordinate is not finite")
    room = room_m(max_error_m, farthest_m * 3**0.5, "coordinate")
    if chosen is Profile.FAST:
        return _pack_deltas(cloud, points, room, intensity)
    head, sections, order = _pack_cloud(points, room)
    if intensity:
        sections = [*sections, *pack_intensity(cloud.intensity[order], True)]
    return replace(head, with_intensity=intensity).seal(*sections)


_Packed = tuple[Head, list[bytes], npt.NDArray[np.int64]]  # the order in which points come back


def _pack_cloud(points: Floats, room: float) -> _Packed:
    """Returns the image of the rings if such are found and it takes fewer bytes, else an octree.

    A sample tells, where it can; near equality the octree is as good, and decoded faster.
    Intensities are not considered, so that they do not affect the decoded positions.
    """
    image = find_rings(points, room)
    if image is None:
        return _pack_tree(points, room)
    if image.is_sure(room):
        return _pack_rings(points, image, room)
    try:
        ratio, error = _sampled_ratio(image, points, room)
        tree = _pack_tree(points, room) if ratio > 1 - error else None
    except CodecError:  # too wide or too regular for a tree
        ratio, tree = 0.0, None
    if tree is not None and ratio >= 1:
        return tree
    rings = _pack_rings(points, image, room)
    return rings if tree is None else min(tree, rings, key=lambda form: sum(map(len, form[1])))


def _sampled_ratio(image: RingImage, points: Floats, room: float) -> tuple[float, float]:
    """Returns a sample's bytes as rings over those as an octree, and how far off that may be.

    The angles of the rings, which a sample needs as much as all points do, count by its share.
    """
    _, (angles, *rings), order = _pack_rings(points, image.sectors(points), room)
    tree = sum(map(len, _pack_tree(points[order], room)[1]))
    share = len(order) / len(points)
    ratio = (share * len(angles) + sum(map(len, rings))) / tree
    error = _SAMPLE_ERROR if image.is_fine(room) else _COARSE_ERROR
    return ratio, max(error, _TABLES / tree)


def _pack_planes(range_m: Floats32, max_error_m: float, step_m: float) -> tuple[list[bytes], int]:
    farthest_m = float(range_m.max())
    if farthest_m >= planes.MAX_STEPS * step_m:
        raise CodecError(
            f"range {farthest_m:.1f} m at a bound of {max_error_m} m: profile fast ends at "
            f"{planes.MAX_STEPS * step_m:.1f} m"
        )
    raw = np.empty(2 * range_m.size, np.uint8)
    points = planes.pack_ranges(range_m, 1.0 / step_m, raw)
    return [compress(raw)], points


def _pack_deltas(cloud: PointCloud, points: Floats, room: float, intensity: bool) -> bytes:
    step_m = 2.0 * room / math.sqrt(3.0)  # the corners of a cubic cell are farthest
    raw = planes.pack_points(np.round(points / step_m).astype(np.int32))
    head = Head(Form.DELTAS, len(points), step_m, with_intensity=intensity)
    return head.seal(compress(raw), *pack_intensity(cloud.intensity, intensity))


def _pack_tree(points: Floats, room: float) -> _Packed:
    edge_m = lattice_edge_m(room)
    sections, order = pack_tree(points, edge_m)
    return Head(Form.TREE, len(points), edge_m), sections, order


def _pack_rings(points: Floats, image: RingImage, room: float) -> _Packed:
    step_m = image_step_m(float(np.sqrt(room**2 - image.beside_m**2)))
    rings, edge_m = image.rings, lattice_edge_m(room)
    sections, _ = pack_image(image.range_m, step_m)
    rest, order = pack_tree(points[image.misfits], edge_m)
    head = Head(Form.RINGS, len(points), step_m, len(rings.elevations), rings.columns)
    sections = [rings.to_bytes(len(image.misfits), edge_m), *sections, *rest]
    return head, sections, np.concatenate([image.order, image.misfits[order]])


def decode(payload: bytes | npt.NDArray[np.uint8]) -> PointCloud:
    """Reads a payload of any form; the points come back in the sensor frame.

    Raises:
        CodecError: the payload is not one, or claims a size beyond the limits.
    """
    head, reader = read_payload(payload if isinstance(payload, bytes) else payload.tobytes())
    points = _UNPACK[head.form](head, reader)
    intensity = unpack_intensity(head, reader)
    reader.end()
    return PointCloud(points, intensity)


def _unpack_planes(head: Head, reader: Reader) -> Floats32:
    raw = decompress(reader.section(), 2 * head.channels * head.columns)
    xyz = np.empty((head.points, 3), np.float32)
    directions = _pattern(head).directions.reshape(-1, 3)
    found = planes.unpack_ranges(raw, directions, head.columns, head.step_m, xyz)
    if found != head.points:
        raise CodecError(f"scan claims {head.points} points, holds {found}")
    return xyz


def _unpack_pattern(head: Head, reader: Reader) -> Floats32:
    spin, section = _pattern(head).spin, reader.section()
    if section:
        spin = Window.from_bytes(section, head.channels, head.columns).cut_spin(spin)
    return unpack_image(head, reader, spin, FRAME_ORIGIN, head.points)


def _unpack_deltas(head: Head, reader: Reader) -> Floats32:
    raw = decompress(reader.section(), 12 * head.points)
    xyz = np.empty((head.points, 3), np.float32)
    if not planes.unpack_points(raw, head.step_m, xyz):
        raise CodecError("a coordinate lies beyond the form's reach")
    return xyz


def _unpack_rings(head: Head, reader: Reader) -> Floats32:
    rings, misfits, edge_m = Rings.from_bytes(reader.section(), head.channels, head.columns)
    beams = head.channels * head.columns
    if not 0 <= head.points - misfits <= beams:
        raise CodecError(
            f"scan claims {head.points} points, {misfits} of them beside {beams} beams"
        )
    placed = unpack_image(head, reader, rings.spin, rings.origin, head.points - misfits)
    return np.concatenate([placed, unpack_tree(reader, misfits, edge_m)])


def _unpack_tree(head: Head, reader: Reader) -> Floats32:
    return unpack_tree(reader, head.points, head.step_m)


def _pattern(head: Head) -> ScanPattern:
    if head.elevations_deg:
        return ScanPattern.of_rings(head.elevations_deg, head.columns)
    return ScanPattern(head.channels, head.columns, head.upper_fov_deg, head.lower_fov_deg)


_UNPACK = {
    Form.PLANES: _unpack_planes,
    Form.IMAGE: _unpack_pattern,
    Form.DELTAS: _unpack_deltas,
    Form.RINGS: _unpack_rings,
    Form.TREE: _unpack_tree,
}
