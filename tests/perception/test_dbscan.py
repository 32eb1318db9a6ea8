"""The grid DBSCAN against the definition, point by point."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from perception.cluster import NOISE, cluster
from perception.config import ClusterConfig
from perception.fast import split

EPS_M = 1.25


def by_definition(
    points: npt.NDArray[np.float32], min_points: int
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_], list[int]]:
    """Returns who is whose neighbour (N, N), who is core (N,), and core points' components."""
    apart = ((points[:, None].astype(np.float64) - points[None]) ** 2).sum(axis=2)
    near = apart <= EPS_M**2
    core = near.sum(axis=1) >= min_points
    component = [-1] * len(points)
    for seed in np.flatnonzero(core):
        todo = [int(seed)] if component[seed] < 0 else []
        while todo:
            point = todo.pop()
            component[point] = int(seed)
            todo += [int(n) for n in np.flatnonzero(near[point] & core) if component[n] < 0]
    return near, core, component


@settings(deadline=None, max_examples=150)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 90),
    spread_m=st.sampled_from([0.5, 3.0, 6.0, 12.0]),
    min_points=st.integers(1, 6),
)
def test_clusters_are_those_of_the_definition(
    seed: int, count: int, spread_m: float, min_points: int
) -> None:
    rng = np.random.default_rng(seed)
    points = (rng.uniform(-spread_m, spread_m, (count, 3)) * [1, 1, 0.3]).astype(np.float32)
    labels = cluster(points, config=ClusterConfig(eps_m=EPS_M, min_points=min_points))
    near, core, component = by_definition(points, min_points)

    pairs = {(component[i], int(labels[i])) for i in np.flatnonzero(core)}
    assert NOISE not in {label for _, label in pairs}
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})
    for i in np.flatnonzero(~core):
        around = {int(labels[j]) for j in np.flatnonzero(near[i] & core)}
        assert (labels[i] in around) if around else (labels[i] == NOISE)


def test_clusters_are_numbered_by_their_first_points() -> None:
    spots = np.repeat([[50.0, 0, 0], [-9.0, 3, 0], [4.0, 4, 1]], 4, axis=0).astype(np.float32)
    assert cluster(spots, config=ClusterConfig()).tolist() == [0] * 4 + [1] * 4 + [2] * 4


def test_an_empty_cloud_has_no_clusters() -> None:
    assert cluster(np.zeros((0, 3), np.float32), config=ClusterConfig()).shape == (0,)


def test_a_queue_that_is_one_cluster_is_parted_and_a_car_is_left_alone():
    rng = np.random.default_rng(3)
    cars = [rng.uniform([x, 0, 0.3], [x + 4.5, 1.8, 1.5], (600, 3)) for x in (0.0, 5.5, 40.0)]
    points = np.concatenate(cars).astype(np.float32)
    config = ClusterConfig()
    together = cluster(points, config=config)
    assert together.max() == 1
    parted = split(points, together, config=config)
    assert [len(set(part)) for part in np.split(parted, 3)] == [1, 1, 1]
    assert sorted(set(parted)) == [0, 1, 2]
    left = split(points, together, config=config.model_copy(update={"split_eps_m": None}))
    np.testing.assert_array_equal(left, together)


def test_two_cars_abreast_that_are_one_cluster_are_parted() -> None:
    rng = np.random.default_rng(3)
    cars = [rng.uniform((0, y, 0.3), (4.6, y + 1.9, 1.5), (800, 3)) for y in (0.0, 2.8)]
    points = np.concatenate(cars).astype(np.float32)
    together = cluster(points, config=ClusterConfig())
    assert together.max() == 0
    parted = split(points, together, config=ClusterConfig())
    assert [len(set(part)) for part in np.split(parted, 2)] == [1, 1]
    assert parted.max() == 1


def test_a_lorry_is_parted_from_the_cars_parked_beside_it() -> None:
    rng = np.random.default_rng(3)
    lorry = rng.uniform((0, 0, 0.6), (8.5, 2.5, 3.4), (6000, 3))
    parked = [rng.uniform((x, 2.95, 0.2), (x + 4.4, 4.7, 1.5), (1500, 3)) for x in (-3.0, 2.2)]
    points = np.concatenate([lorry, *parked]).astype(np.float32)
    labels = split(points, cluster(points, config=ClusterConfig()), config=ClusterConfig())
    assert len(set(labels[:6000])) == 1
    assert labels[0] not in labels[6000:]
