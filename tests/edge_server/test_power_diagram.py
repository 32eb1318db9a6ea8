"""The plan's geometry, on any agents that can be thought of."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.power_diagram import (
    PLAIN,
    TIGHT,
    WIDE,
    cells,
    neighbours,
    partners,
    power_weights,
    voronoi_weights,
)

Floats = npt.NDArray[np.float64]
BOX = np.array([-400.0, -400.0, 400.0, 400.0])
ALPHA = 0.3

places = st.one_of(
    st.tuples(st.floats(-200, 200), st.floats(-200, 200)),
    st.tuples(st.integers(-3, 3), st.integers(-3, 3)),  # often at one place, or in one line
    st.tuples(st.integers(-50, 50), st.just(0)),
)
rates = st.floats(0.1, 1000)


@st.composite
def scenes(draw: st.DrawFn, least: int = 1) -> tuple[Floats, Floats]:
    """Returns sites (N, 2) and weights (N, 3)."""
    agents = draw(st.lists(st.tuples(places, rates), min_size=least, max_size=7))
    sites = np.round(np.array([place for place, _ in agents], np.float64).reshape(-1, 2), 2)
    mbps = np.array([rate for _, rate in agents])
    return sites, power_weights(sites, mbps, alpha=draw(st.floats(0, 0.4)))


def area_m2(polygon: Floats) -> float:
    x, y = polygon.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2) if len(polygon) else 0.0


def within(polygon: Floats, place: Floats, slack_m: float) -> bool:
    along = np.roll(polygon, -1, axis=0) - polygon
    length_m = np.linalg.norm(along, axis=1)
    real = length_m > 1e-6  # a shorter edge has no direction
    to_place, along, length_m = (place - polygon)[real], along[real], length_m[real]
    inward_m = (along[:, 0] * to_place[:, 1] - along[:, 1] * to_place[:, 0]) / length_m
    return len(polygon) > 0 and bool((inward_m >= -slack_m).all())


def powers(sites: Floats, place: Floats, weights_m2: Floats) -> Floats:
    return np.asarray(((sites - place) ** 2).sum(axis=1) - weights_m2)


@given(scenes())
def test_the_plain_cells_tile_the_scene(scene: tuple[Floats, Floats]) -> None:
    sites, weights_m2 = scene
    total_m2 = sum(area_m2(cell) for cell in cells(sites, weights_m2, BOX, border=PLAIN))
    assert total_m2 == pytest.approx(800.0**2, rel=1e-6)


@given(scenes(), st.tuples(st.floats(-400, 400), st.floats(-400, 400)))
def test_a_place_lies_in_the_cell_of_the_agent_with_the_least_power_distance(
    scene: tuple[Floats, Floats], at: tuple[float, float]
) -> None:
    sites, weights_m2 = scene
    place = np.array(at)
    owner = int(np.argmin(powers(sites, place, weights_m2[:, PLAIN])))
    assert within(cells(sites, weights_m2, BOX, border=PLAIN)[owner], place, 1e-3)


@given(scenes())
def test_the_three_borders_lie_within_each_other(scene: tuple[Floats, Floats]) -> None:
    tight, plain, wide = (cells(*scene, BOX, border=border) for border in (TIGHT, PLAIN, WIDE))
    for inner, outer in [*zip(tight, plain, strict=True), *zip(plain, wide, strict=True)]:
        assert all(within(outer, corner, 1e-3) for corner in inner)


@given(scenes())
def test_no_uplink_is_fast_enough_to_take_the_place_where_another_stands(
    scene: tuple[Floats, Floats],
) -> None:
    sites, weights_m2 = scene
    for i, j in combinations(range(len(sites)), 2):
        apart_m2 = ((sites[i] - sites[j]) ** 2).sum()
        assert abs(weights_m2[i, PLAIN] - weights_m2[j, PLAIN]) <= apart_m2 / 2 + 1e-9
        assert weights_m2[i, WIDE] - weights_m2[j, TIGHT] <= apart_m2 + 1e-9
    assert (np.abs(weights_m2) < 3 * 400**2).all()


@given(scenes(least=0), st.permutations(range(7)))
def test_the_order_of_agents_is_no_matter_for_their_weights(
    scene: tuple[Floats, Floats], order: list[int]
) -> None:
    sites, _ = scene
    some = [i for i in order if i < len(sites)]
    mbps = np.arange(1.0, len(sites) + 1)
    before = power_weights(sites, mbps, alpha=ALPHA)
    after = power_weights(sites[some], mbps[some], alpha=ALPHA)
    np.testing.assert_allclose(after, before[some], atol=1e-9)


@given(scenes())
def test_equal_rates_give_an_ordinary_voronoi_diagram(scene: tuple[Floats, Floats]) -> None:
    sites, _ = scene
    weights_m2 = power_weights(sites, np.full(len(sites), 7.0), alpha=ALPHA)
    np.testing.assert_allclose(weights_m2[:, PLAIN], voronoi_weights(sites)[:, PLAIN], atol=1e-6)


@given(st.floats(1, 100), st.floats(1, 100))
def test_the_faster_of_two_uplinks_has_the_larger_cell(first: float, second: float) -> None:
    sites = np.array([[-50.0, 0], [50, 0]])
    weights_m2 = power_weights(sites, np.array([first, second]), alpha=ALPHA)
    a, b = (area_m2(cell) for cell in cells(sites, weights_m2, BOX, border=PLAIN))
    assert (a >= b - 1e-6) if first >= second else (b >= a - 1e-6)


def test_a_vehicle_with_a_hundredfold_rate_leaves_the_junction_to_the_post() -> None:
    post_and_vehicle = np.array([[0.0, 0], [8, 0]])
    weights_m2 = power_weights(post_and_vehicle, np.array([1.0, 100.0]), alpha=ALPHA)
    for border in (TIGHT, PLAIN):
        assert within(cells(post_and_vehicle, weights_m2, BOX, border=border)[0], np.zeros(2), 0)


def test_neighbours_are_those_of_the_power_diagram_not_of_the_voronoi_diagram() -> None:
    sites = np.array([[-30.0, 0], [0, 20], [30, 0], [0, -60]])
    voronoi = neighbours(sites, voronoi_weights(sites), BOX)
    assert (0, 2) in voronoi
    assert (1, 3) not in voronoi
    weights_m2 = voronoi_weights(sites)
    weights_m2[1] += 1200.0  # its cell grows in between the two
    power = neighbours(sites, weights_m2, BOX)
    assert (0, 2) not in power
    assert (1, 3) in power


@settings(max_examples=60)
@given(scenes())
def test_neighbours_own_places_side_by_side_and_partners_are_at_least_the_neighbours(
    scene: tuple[Floats, Floats],
) -> None:
    sites, weights_m2 = scene
    plain = cells(sites, weights_m2, BOX, border=PLAIN)
    found = neighbours(sites, weights_m2, BOX)
    assert set(found) <= set(partners(sites, weights_m2, BOX))
    for i in range(len(sites)):
        for corner, following in zip(plain[i], np.roll(plain[i], -1, axis=0), strict=True):
            if np.linalg.norm(following - corner) < 0.1:
                continue
            middle = (corner + following) / 2
            if np.abs(middle).max() > 399.9:
                continue  # an edge of the scene
            near = powers(sites, middle, weights_m2[:, PLAIN])
            same = np.flatnonzero(near <= near[i] + 1e-6)
            if len(same) == 2:  # nobody else comes near: the two must be neighbours
                assert (int(same[0]), int(same[1])) in found


def test_without_agents_there_is_nothing_to_plan() -> None:
    nobody = np.zeros((0, 2))
    weights_m2 = power_weights(nobody, np.zeros(0), alpha=ALPHA)
    assert weights_m2.shape == (0, 3)
    assert cells(nobody, weights_m2, BOX, border=PLAIN) == []
    assert partners(nobody, weights_m2, BOX) == []


def test_one_agent_has_the_whole_scene() -> None:
    alone = np.array([[3.0, 4.0]])
    (cell,) = cells(alone, power_weights(alone, np.ones(1), alpha=ALPHA), BOX, border=TIGHT)
    assert area_m2(cell) == pytest.approx(800.0**2)
