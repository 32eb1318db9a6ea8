from dataclasses import replace

import numpy as np
import pytest

from protocol.codec import decode, encode_cloud
from protocol.codec.beam_origin import BeamOrigin, find_origin
from protocol.codec.forms import room_m
from protocol.codec.lattice import lattice_edge_m
from protocol.codec.octree import pack_tree
from protocol.codec.payload import PREFIX, Form, read_payload
from protocol.codec.rings import Rings, find_rings
from protocol.errors import CodecError
from protocol.scans import PointCloud, ScanPattern


def ringed(seed: int = 0, columns: int = 600, loss: float = 0.3) -> np.ndarray:
    """Points (N, 3) of a sensor in a hall, each ring turned by an angle of its own, shuffled."""
    rng = np.random.default_rng(seed)
    elevations = np.radians([14.9, 11, 8, 5, 3, 2, 1.8, 1.6, 1.4, 1.2, 1, 0, -1, -3, -9, -25])
    turn = rng.uniform(0, 2 * np.pi, 16)[:, None]
    azimuth = turn + np.arange(columns) * (2 * np.pi / columns)
    elevation = np.broadcast_to(elevations[:, None], azimuth.shape)
    flat = np.cos(elevation)
    away = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
    hall = 1 / np.abs(away / [30, 20, 4]).max(axis=-1)
    range_m = hall + rng.normal(0, 0.02, hall.shape)
    points = (away * range_m[..., None])[rng.random(hall.shape) >= loss]
    return rng.permutation(points).astype(np.float32)


def named(points: np.ndarray, bound_m: float, names: np.ndarray) -> np.ndarray:
    """Returns the decoded points that carry a name, in its order."""
    shade = np.zeros(len(points), np.float32)
    shade[names] = np.arange(1, len(names) + 1) / 255
    back = decode(encode_cloud(PointCloud(points, shade), bound_m, intensity=True))
    kept = np.round(back.intensity * 255).astype(int)
    assert len(back.points) == len(points)
    order = np.argsort(kept, kind="stable")[-len(names) :]
    assert kept[order].tolist() == list(range(1, len(names) + 1))
    return back.points[order]


@pytest.mark.parametrize("loss", [0.05, 0.3, 0.45])
@pytest.mark.parametrize("bound_m", [0.002, 0.02, 0.2])
def test_rings_are_found_and_every_point_stays_within_the_bound(bound_m, loss):
    points = ringed(loss=loss)
    payload = encode_cloud(PointCloud(points, np.zeros(len(points), np.float32)), bound_m)
    assert payload[4] == Form.RINGS
    for start in range(0, len(points), 250 * 8):
        names = np.arange(start, min(start + 250, len(points)))
        back = named(points, bound_m, names)
        assert np.linalg.norm(back.astype(float) - points[names], axis=1).max() <= bound_m


def test_the_rings_are_those_of_the_sensor():
    image = find_rings(ringed().astype(np.float64), 0.02)
    assert image is not None
    assert image.rings.columns == 600
    assert np.allclose(
        np.degrees(image.rings.elevations),
        [14.9, 11, 8, 5, 3, 2, 1.8, 1.6, 1.4, 1.2, 1, 0, -1, -3, -9, -25],
        atol=1e-3,
    )
    assert len(image.misfits) == 0


def test_points_off_the_rings_and_second_returns_come_back_too():
    points = ringed()
    rng = np.random.default_rng(3)
    loose = rng.normal(0, 8, (100, 3)).astype(np.float32)
    twice = points[:100] * np.float32(1.5)
    everything = np.concatenate([points, loose, twice, points[:20], np.zeros((5, 3), np.float32)])
    payload = encode_cloud(PointCloud(everything, np.zeros(len(everything), np.float32)), 0.02)
    assert payload[4] == Form.RINGS
    names = np.arange(len(points), len(everything))
    back = named(everything, 0.02, names)
    assert np.linalg.norm(back.astype(float) - everything[names], axis=1).max() <= 0.02


def test_a_ringed_cloud_takes_far_less_than_a_tree_of_it():
    points = ringed()
    shade = np.zeros(len(points), np.float32)
    rings = encode_cloud(PointCloud(points, shade), 0.02)
    moved = points + np.float32([5.0, 3.0, 1.0])  # the sensor is no longer at the origin
    tree = encode_cloud(PointCloud(moved, shade), 0.02)
    assert tree[4] == Form.TREE
    assert len(rings) < 0.6 * len(tree)


@pytest.mark.parametrize("seed", range(5))
def test_a_cloud_without_rings_becomes_a_tree(seed):
    points = np.random.default_rng(seed).normal(0, 20, (3000, 3)).astype(np.float32)
    payload = encode_cloud(PointCloud(points, np.zeros(3000, np.float32)), 0.02)
    assert payload[4] == Form.TREE


def test_a_ring_image_of_a_pattern_holds_every_return():
    pattern = ScanPattern(16, 512, 10.0, -10.0)
    points = (pattern.directions.reshape(-1, 3) * np.float32(12)).astype(np.float64)
    image = find_rings(points, 0.01)
    assert image is not None
    assert (image.range_m > 0).sum() == len(points)


def off_origin(points: np.ndarray, origin: BeamOrigin) -> np.ndarray:
    """Returns points whose beams begin elsewhere."""
    away_m = np.hypot(points[:, 0], points[:, 1])[:, None]
    out = points * [1.0, 1.0, 0.0] / away_m
    return (points + origin.radius_m * out + [0.0, 0.0, origin.height_m]).astype(np.float32)


@pytest.mark.parametrize("bound_m", [0.005, 0.02, 0.1])
@pytest.mark.parametrize("height_m", [-0.06, 0.036, 0.075])
@pytest.mark.parametrize("radius_m", [0.0, 0.028])
def test_where_beams_begin_is_found_and_costs_no_bytes(bound_m, height_m, radius_m):
    points, origin = ringed().astype(np.float64), BeamOrigin(height_m, radius_m)
    moved = off_origin(points, origin)
    found = find_origin(moved.astype(np.float64))
    assert abs(found.height_m - height_m) < 0.006
    shade = np.zeros(len(points), np.float32)
    payload = encode_cloud(PointCloud(moved, shade), bound_m)
    assert payload[4] == Form.RINGS
    usual = encode_cloud(PointCloud(points.astype(np.float32), shade), bound_m)
    assert len(payload) < 1.1 * len(usual)
    for start in range(0, len(moved), 250 * 8):
        names = np.arange(start, min(start + 250, len(moved)))
        back = named(moved, bound_m, names)
        assert np.linalg.norm(back.astype(float) - moved[names], axis=1).max() <= bound_m


def test_clouds_seen_from_the_frames_origin_or_from_nowhere_stay_as_they_are():
    assert find_origin(ringed().astype(np.float64)) == BeamOrigin()
    loose = np.random.default_rng(1).normal(0, 20, (3000, 3))
    assert find_origin(loose) == BeamOrigin()
    assert find_origin(np.zeros((300, 3))) == BeamOrigin()
    above = np.repeat([[0.0, 0.0, 1.0]], 300, axis=0)
    assert np.isfinite(BeamOrigin(0.1, 0.1).seen_from(above)).all()


@pytest.mark.parametrize("origin", [(np.nan, 0), (np.inf, 0), (2, 0), (0, -0.1), (0, np.nan)])
def test_beams_that_begin_far_away_are_refused(origin):
    rings = Rings(np.zeros(2, np.float32), np.zeros(2, np.uint16), 8, BeamOrigin(*origin))
    with pytest.raises(CodecError, match="beams that begin"):
        Rings.from_bytes(rings.to_bytes(0, 0.1), 2, 8)


def test_points_beside_their_beams_stay_within_the_bound():
    rng = np.random.default_rng(5)
    points = ringed(columns=1200, loss=0.05).astype(np.float64)
    across = np.cross(points, [0, 0, 1])
    across *= (
        rng.uniform(0.012, 0.014, len(points))[:, None] / np.linalg.norm(across, axis=1)[:, None]
    )
    moved = (points + across).astype(np.float32)
    payload = encode_cloud(PointCloud(moved, np.zeros(len(moved), np.float32)), 0.02)
    assert payload[4] == Form.RINGS
    worst_m = 0.0
    for start in range(0, len(moved), 250):
        names = np.arange(start, min(start + 250, len(moved)))[:250]
        back = named(moved, 0.02, names)
        worst_m = max(worst_m, np.linalg.norm(back.astype(float) - moved[names], axis=1).max())
    assert worst_m <= 0.02


@pytest.mark.parametrize("claimed", [-1, 1])
def test_more_points_than_beams_and_fewer_than_lie_beside_them_are_refused(claimed):
    points = np.concatenate([ringed(), np.full((100, 3), 7, np.float32)])
    payload = encode_cloud(PointCloud(points, np.zeros(len(points), np.float32)), 0.02)
    head, reader = read_payload(payload)
    rings = reader.section()
    misfits = Rings.from_bytes(rings, head.channels, head.columns)[1]
    assert misfits >= 99
    beams = head.channels * head.columns
    limit = misfits if claimed < 0 else beams + misfits
    sections = [rings, *(reader.section() for _ in range(3))]
    with pytest.raises(CodecError, match=f"{misfits} of them beside {beams} beams"):
        decode(replace(head, points=limit + claimed).seal(*sections))
    with pytest.raises(CodecError) as refusal:
        decode(replace(head, points=limit).seal(*sections))
    assert "of them beside" not in str(refusal.value)


def smeared() -> np.ndarray:
    """A sensor whose lasers stand apart, so that each ring falls into several, hardly filled."""
    rng = np.random.default_rng(0)
    elevation = np.radians(np.linspace(10, -20, 48))[:, None]
    azimuth = np.arange(900) * (2 * np.pi / 900) + np.zeros((48, 1))
    flat = np.cos(elevation) + 0 * azimuth
    away = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation + 0 * flat)])
    hall = 1 / np.abs(away / np.array([30.0, 20.0, 4.0])[:, None, None]).max(axis=0)
    points = (away * (hall + rng.normal(0, 0.02, hall.shape))).reshape(3, -1).T
    points[:, 2] += np.repeat(0.05 + 0.003 * np.arange(48), 900)
    return points.astype(np.float32)


def indoors(loss: float = 0.0) -> np.ndarray:
    """A sensor with many lasers in a room, where neighbouring points lie a centimetre apart."""
    pattern = ScanPattern(64, 2048, 16.6, -16.6)
    away = pattern.directions.reshape(-1, 3)
    room = 1 / np.abs(away / [5, 4, 1.4]).max(axis=1)
    rng = np.random.default_rng(0)
    points = away * (room + rng.normal(0, 0.01, room.shape))[:, None]
    return points[rng.random(len(points)) >= loss].astype(np.float32)


@pytest.mark.parametrize("bound_m", [0.02, 0.05, 0.1, 0.3, 1.0])
def test_a_cloud_takes_the_smaller_of_its_forms(bound_m):
    for points in (ringed(), ringed(loss=0.9), smeared(), indoors(), indoors(0.3), indoors(0.6)):
        plain = PointCloud(points, np.zeros(len(points), np.float32))
        farthest_m = 3**0.5 * float(np.abs(points.astype(np.float64)).max())
        edge_m = lattice_edge_m(room_m(bound_m, farthest_m, "coordinate"))
        tree = sum(map(len, pack_tree(points.astype(np.float64), edge_m)[0]))
        assert len(encode_cloud(plain, bound_m)) <= tree + PREFIX.size + 40  # lengths of sections


def test_a_sample_has_points_to_all_sides_and_those_beside_the_rings():
    points = np.concatenate([smeared(), np.full((100, 3), 7, np.float32)]).astype(np.float64)
    image = find_rings(points, 0.1)
    sample = image.sectors(points)
    assert len(sample.range_m) == len(image.rings.elevations)
    assert sample.range_m.shape[1] == pytest.approx(image.rings.columns / 8, rel=0.05)
    kept = points[np.concatenate([sample.order, sample.misfits])]
    assert len(kept) == pytest.approx(len(points) / 8, rel=0.1)
    sector = (np.degrees(np.arctan2(kept[:, 1], kept[:, 0])) // 45).astype(np.int64) % 8
    assert np.bincount(sector).tolist() == pytest.approx([len(kept) / 8] * 8, rel=0.1)
    assert np.count_nonzero(sample.range_m) == len(sample.order)


def test_of_what_is_seen_in_one_direction_alone_there_is_a_sample_too():
    points = ringed().astype(np.float64)
    ahead = points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < np.radians(20)]
    sample = find_rings(ahead, 0.05).sectors(ahead)
    assert len(sample.order) + len(sample.misfits) >= min(2048, len(ahead)) * 0.9


def test_only_rings_beside_which_no_points_lie_are_taken_without_a_sample():
    image = find_rings(ringed().astype(np.float64), 0.1)
    assert image is not None
    assert image.is_sure(0.1)
    assert not replace(image, beside_m=0.025).is_sure(0.1)


@pytest.mark.parametrize(("bound_m", "is_sure"), [(0.01, True), (0.1, False)])
def test_where_many_points_lie_within_a_bound_a_sample_is_asked(bound_m, is_sure):
    image = find_rings(indoors().astype(np.float64), bound_m)
    assert image is not None
    assert image.is_sure(bound_m) == is_sure
