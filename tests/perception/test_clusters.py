"""Clusters as runs: the same as their points' labels, however these lie."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from perception.arrays import Ints32
from perception.boxes import main_sensors
from perception.cluster import NOISE, renumber
from perception.clusters import Clusters

LABELS = st.lists(st.integers(NOISE, 5), max_size=60)


def numbered(labels: list[int]) -> Ints32:
    found = np.array(labels, np.int32)
    renumber(found)
    return found


@given(LABELS)
def test_runs_hold_each_point_of_a_cluster_once(labels: list[int]) -> None:
    given_labels = numbered(labels)
    clusters = Clusters.of(given_labels)
    assert clusters.count == given_labels.max(initial=NOISE) + 1
    np.testing.assert_array_equal(clusters.labels(len(labels)), given_labels)


@given(LABELS, st.lists(st.integers(0, 5), min_size=6, max_size=6))
def test_joined_clusters_are_those_of_joined_labels(labels: list[int], owner: list[int]) -> None:
    given_labels = numbered(labels)
    clusters = Clusters.of(given_labels)
    of_each = np.array([min(who, n) for n, who in enumerate(owner)])[: clusters.count]
    expected = np.where(given_labels >= 0, np.append(of_each, NOISE)[given_labels], NOISE)
    whole = expected.astype(np.int32)
    renumber(whole)
    joined, again = clusters.joined(of_each), Clusters.of(whole)
    assert joined.count == again.count
    np.testing.assert_array_equal(joined.runs, again.runs)


@given(LABELS, st.integers(0, 10**6))
def test_means_and_sensors_are_those_of_the_points(labels: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    given_labels, points = numbered(labels), rng.uniform(-50, 50, (len(labels), 3))
    points = points.astype(np.float32)
    clusters = Clusters.of(given_labels)
    members, middles = clusters.means(points)
    sizes = rng.multinomial(len(labels), [0.3, 0.0, 0.7])
    part_of = np.repeat([0, 1, 2], sizes)
    places = main_sensors(clusters, sizes, np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]))
    for n in range(clusters.count):
        mine = given_labels == n
        assert members[n] == mine.sum()
        np.testing.assert_allclose(middles[n], points[mine].mean(axis=0, dtype=np.float64))
        assert places[n, 0] == np.bincount(part_of[mine]).argmax()
