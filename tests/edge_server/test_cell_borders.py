"""A frame ends early only when every place of the scene is covered."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.completion import CellBorders, UploadProgress
from edge_server.planner import borders_of
from edge_server.power_diagram import power_weights
from sensing.upload_selection import cut

BOX = np.array([-400.0, -400.0, 400.0, 400.0])
PLACES = np.random.default_rng(5).uniform(-400, 400, (3000, 2)).astype(np.float32)

agents = st.lists(
    st.tuples(
        st.one_of(
            st.tuples(st.floats(-300, 300), st.floats(-300, 300)),
            st.tuples(st.integers(-2, 2), st.integers(-40, 40)),
        ),
        st.floats(0.5, 100),
        st.integers(0, 4),
    ),
    min_size=1,
    max_size=7,
)


@settings(max_examples=300)
@given(agents, st.floats(0, 0.4))
def test_when_neighbours_cover_the_space_between_them_no_place_is_left(
    scene: list[tuple[tuple[float, float], float, int]], alpha: float
) -> None:
    sites = np.round(np.array([place for place, _, _ in scene], np.float64), 2)
    weights_m2 = power_weights(sites, np.array([rate for _, rate, _ in scene]), alpha=alpha)
    came = {str(i): chunks for i, (_, _, chunks) in enumerate(scene)}
    if not borders_of(list(came), sites, weights_m2, BOX).covered(came):
        return
    covered = np.zeros(len(PLACES), np.bool_)
    for own, (_, _, chunks) in enumerate(scene):
        border = np.zeros(len(PLACES), np.uint8)
        cut(PLACES, border, sites, weights_m2, own)
        covered |= border < chunks
    assert covered.all()


def test_two_neighbours_need_four_chunks_together() -> None:
    borders = CellBorders(("a", "b", "c"), ("a", "b"), (("a", "b"),))
    assert borders.covered({"a": 1, "b": 3, "c": 0})
    assert not borders.covered({"a": 1, "b": 2, "c": 4})


def test_an_owner_s_own_part_is_needed_whatever_its_neighbours_sent() -> None:
    borders = CellBorders(("a", "b", "c"), ("a", "b"), (("a", "b"), ("b", "c")))
    assert not borders.covered({"a": 4, "b": 0, "c": 4})
    assert borders.covered({"a": 4, "b": 1, "c": 4})


def test_who_has_left_is_not_waited_for_and_who_is_alone_needs_one_chunk() -> None:
    borders = CellBorders(("a", "b"), ("a", "b"), (("a", "b"),))
    assert borders.covered({"a": 1})
    assert not borders.covered({"a": 0})
    assert CellBorders((), (), ()).covered({})


def test_chunks_count_by_their_own_plan_and_a_whole_scan_by_any() -> None:
    part, whole = UploadProgress(2, 4, plan_frame=7), UploadProgress(4, 4, plan_frame=7)
    assert [part.came_by(plan) for plan in (7, 8)] == [2, 0]
    assert [whole.came_by(plan) for plan in (7, 8)] == [4, 4]
    assert UploadProgress(1, 1, plan_frame=-1).came_by(8) == 4  # of a newcomer, all it sees
    assert UploadProgress(0, 0, plan_frame=-1).came_by(8) == 0
