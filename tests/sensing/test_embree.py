"""Rays in packets against each ray and triangle by themselves."""

from __future__ import annotations

import gc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from perception.arrays import Floats32, Ints32
from sensing.embree import Caster
from sensing.mesh import TriangleMesh

SEEDS = st.integers(0, 2**32 - 1)
FLOOR = TriangleMesh.of([[-9, -9, 0], [9, -9, 0], [0, 9, 0]], [[0, 1, 2]])


def nearest(
    corners: NDArray[np.float64], starts: NDArray[np.float64], rays: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Returns where rays first hit (N,), inf for nowhere, and which pass too near an edge to say.

    After Moeller and Trumbore (1997).
    """
    a, b, c = (corners[None, :, k] for k in range(3))
    one, two, ray = b - a, c - a, rays[:, None]
    across = np.cross(ray, two)
    size = (across * one).sum(-1)
    shift = starts[:, None] - a
    u = (across * shift).sum(-1) / size
    other = np.cross(shift, one)
    v = (other * ray).sum(-1) / size
    t = (other * two).sum(-1) / size
    margin = np.minimum(np.minimum(u, v), np.minimum(1 - u - v, t))
    hit = np.where(margin > 0, t, np.inf)
    return hit.min(axis=1, initial=np.inf), (np.abs(margin) < 1e-3).any(axis=1)


def cast(caster: Caster, starts: Floats32, rays: Floats32, limits: Floats32) -> Ints32:
    """Lowers the limits, and returns the triangles that were hit, -1 for none."""
    before, faces = limits.copy(), np.full(len(limits), -7, np.int32)
    caster.cast(starts, rays, limits, faces)
    return np.where(limits < before, faces, -1).astype(np.int32)


def by_axis(vectors: NDArray[np.float64]) -> Floats32:
    return np.ascontiguousarray(vectors.T, np.float32)


@settings(deadline=None, max_examples=60)
@given(SEEDS, st.integers(1, 50), st.integers(0, 70))
def test_packets_find_what_each_ray_finds_alone(seed: int, triangles: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-10, 10, (triangles, 3, 3))
    starts, rays = rng.uniform(-10, 10, (count, 3)), rng.normal(size=(count, 3))
    limits = np.full(count, 25, np.float32)
    mesh = TriangleMesh.of(corners.reshape(-1, 3), np.arange(3 * triangles).reshape(-1, 3))
    cast(Caster(mesh), by_axis(starts), by_axis(rays), limits)
    expected, unsure = nearest(corners, starts, rays)
    expected = np.minimum(expected, 25)
    assert limits[~unsure] == pytest.approx(expected[~unsure], rel=1e-4, abs=1e-4)


@given(SEEDS, st.integers(1, 40))
@settings(deadline=None, max_examples=30)
def test_one_origin_serves_all_rays(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    start = rng.uniform([-2, -2, 2], [2, 2, 6])
    rays = by_axis(rng.normal(size=(count, 3)))
    together, apart = np.full((2, count), 50, np.float32)
    caster = Caster(FLOOR)
    cast(caster, by_axis(start[None]), rays, together)
    cast(caster, by_axis(np.repeat(start[None], count, axis=0)), rays, apart)
    assert (together == apart).all()


def test_a_ray_s_neighbours_do_not_change_it() -> None:
    rays = by_axis(np.random.default_rng(5).normal(size=(64, 3)))
    start = by_axis(np.array([[0.0, 0.0, 3.0]]))
    caster = Caster(FLOOR)
    whole = np.full(64, 50, np.float32)
    cast(caster, start, rays, whole)
    assert (whole < 50).any()
    for first in (1, 7, 40):
        part = np.full(64 - first, 50, np.float32)
        cast(caster, start, np.ascontiguousarray(rays[:, first:]), part)
        assert (part == whole[first:]).all()


def test_a_nearer_limit_stays_and_buffers_may_be_longer_than_what_is_asked() -> None:
    down = np.repeat([[0.0], [0.0], [-1.0]], 40, axis=1).astype(np.float32)
    limits = np.array([1.0, 5.0], np.float32)
    cast(Caster(FLOOR), np.array([[0], [0], [3]], np.float32), down, limits)
    assert limits.tolist() == [1.0, 3.0]


def test_a_hit_names_its_triangle() -> None:
    triangles = [[0, 1, 2], [3, 4, 5]]
    low, high = [[-1, -1, 0], [1, -1, 0], [0, 1, 0]], [[9, -1, 1], [11, -1, 1], [10, 1, 1]]
    caster = Caster(TriangleMesh.of(np.array([*low, *high], np.float64), triangles))
    starts = np.array([[0, 0, 5], [10, 0, 5], [5, 0, 5]], np.float64)
    down = np.repeat([[0.0, 0.0, -1.0]], 3, axis=0)
    limits = np.full(3, 50, np.float32)
    assert cast(caster, by_axis(starts), by_axis(down), limits).tolist() == [0, 1, -1]
    assert limits.tolist() == pytest.approx([5, 4, 50], rel=1e-6)


def test_no_triangles_and_no_rays() -> None:
    nothing = TriangleMesh.of(np.empty((0, 3)), np.empty((0, 3)))
    limits = np.array([7.0], np.float32)
    cast(Caster(nothing), np.zeros((3, 1), np.float32), np.ones((3, 1), np.float32), limits)
    cast(Caster(FLOOR), np.zeros((3, 1), np.float32), np.ones((3, 0), np.float32), limits[:0])
    assert limits.tolist() == [7.0]


def test_casters_come_and_go() -> None:
    for _ in range(50):
        limits = np.array([9.0], np.float32)
        start, down = np.array([[0], [0], [1]], np.float32), np.array([[0], [0], [-1]], np.float32)
        cast(Caster(FLOOR), start, down, limits)
        gc.collect(0)  # what has just been let go; all else takes longer than the casting
        assert limits.tolist() == [1.0]
