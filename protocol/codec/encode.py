"""From a scan or a cloud to bytes."""

from __future__ import annotations

import numpy as np

from protocol.codec import planes
from protocol.codec.beams import image_step_m, pack_image
from protocol.codec.draco import bits_for, pack_draco
from protocol.codec.payload import Form, Head, seal_intensity, squeeze
from protocol.codec.rings import RingImage, find_rings
from protocol.codec.step import check_bound, room_m
from protocol.codec.tree import cell_edge_m, pack_tree
from protocol.codec.window import Window
from protocol.errors import CodecError
from protocol.profiles import Profile, profile_named
from protocol.scans import MAX_POINTS, Floats, Floats32, PointCloud, RangeScan


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
    if chosen is Profile.DRACO:
        return _draco(scan.cloud(), room, intensity)
    range_m = np.ascontiguousarray(scan.range_m, np.float32)
    if chosen is Profile.FAST:
        form, step_m = Form.PLANES, 2.0 * room
        sections, points = _planes(range_m, max_error_m, step_m)
    else:
        form, step_m = Form.IMAGE, image_step_m(room)
        window = Window.around(range_m)
        image = range_m if window is None else window.cut(range_m)
        sections, points = pack_image(image, step_m)
        sections = [b"" if window is None else window.to_bytes(), *sections]
    shades = seal_intensity(scan.intensity[scan.range_m > 0], True) if intensity else []
    pattern = scan.pattern
    fov_deg = (pattern.upper_fov_deg, pattern.lower_fov_deg)
    beams = (pattern.channels, pattern.columns)
    return Head(form, points, step_m, *beams, *fov_deg, intensity).seal(*sections, *shades)


def encode_cloud(
    cloud: PointCloud,
    max_error_m: float,
    *,
    profile: str = Profile.DEFAULT,
    intensity: bool = False,
) -> bytes:
    """Encodes an unordered cloud; every point moves by at most `max_error_m`.

    Profile `fast` keeps the order of the points; the others do not. A cloud of one spinning LiDAR
    becomes a range image of the rings that are found in it, any other an octree.

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
    if chosen is Profile.DRACO:
        return _draco(cloud, room, intensity)
    if chosen is Profile.FAST:
        return _deltas(cloud, points, room, intensity)
    image = find_rings(points, room)
    if image is not None:
        return _rings(cloud, points, image, room, intensity)
    edge_m = cell_edge_m(room)
    sections, order = pack_tree(points, edge_m)
    shades = seal_intensity(cloud.intensity[order], True) if intensity else []
    head = Head(Form.TREE, len(points), edge_m, with_intensity=intensity)
    return head.seal(*sections, *shades)


def _planes(range_m: Floats32, max_error_m: float, step_m: float) -> tuple[list[bytes], int]:
    farthest_m = float(range_m.max())
    if farthest_m >= planes.MAX_STEPS * step_m:
        raise CodecError(
            f"range {farthest_m:.1f} m at a bound of {max_error_m} m: profile fast ends at "
            f"{planes.MAX_STEPS * step_m:.1f} m"
        )
    raw = np.empty(2 * range_m.size, np.uint8)
    points = planes.pack_ranges(range_m, 1.0 / step_m, raw)
    return [squeeze(raw)], points


def _deltas(cloud: PointCloud, points: Floats, room: float, intensity: bool) -> bytes:
    step_m = cell_edge_m(room)
    if len(points) and float(np.abs(points).max()) >= (2**30 - 1) * step_m:
        raise CodecError(f"a coordinate takes more than 2^30 steps of {step_m} m")
    raw = planes.pack_points(np.round(points / step_m).astype(np.int32))
    head = Head(Form.DELTAS, len(points), step_m, with_intensity=intensity)
    return head.seal(squeeze(raw), *seal_intensity(cloud.intensity, intensity))


def _rings(
    cloud: PointCloud, points: Floats, image: RingImage, room: float, intensity: bool
) -> bytes:
    step_m = image_step_m(float(np.sqrt(room**2 - image.beside_m**2)))
    rings = image.rings
    sections, _ = pack_image(image.range_m, step_m)
    rest, order = pack_tree(points[image.misfits], cell_edge_m(room))
    shades = []
    if intensity:
        order = np.concatenate([image.order, image.misfits[order]])
        shades = seal_intensity(cloud.intensity[order], True)
    head = Head(
        Form.RINGS,
        len(points),
        step_m,
        len(rings.elevations),
        rings.columns,
        with_intensity=intensity,
    )
    return head.seal(
        rings.to_bytes(len(image.misfits), cell_edge_m(room)), *sections, *rest, *shades
    )


def _draco(cloud: PointCloud, room: float, intensity: bool) -> bytes:
    if intensity:
        raise CodecError("profile draco sends geometry only")
    packed, points = pack_draco(cloud.points, bits_for(cloud.points, room))
    return Head(Form.DRACO, points, 2 * room).seal(packed)
