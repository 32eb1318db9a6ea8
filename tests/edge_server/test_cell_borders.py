"""A frame ends early only when every place of the scene is covered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.completion import CellBorders, UploadProgress
from edge_server.config import PlanConfig
from edge_server.coverage import SensorViews
from edge_server.frame import Chunk, Frame
from edge_server.planner import Partition, Planner, borders_of
from edge_server.power_diagram import power_weights
from sensing.upload_selection import cut
from tests.edge_server.test_sites import scan
from tests.roads import MAIN_AND_SIDE

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


@settings(max_examples=50)
@given(agents, st.floats(0, 0.4))
def test_an_agents_cell_is_what_it_cuts_from_its_scan(
    scene: list[tuple[tuple[float, float], float, int]], alpha: float
) -> None:
    sites = np.round(np.array([place for place, _, _ in scene], np.float64), 2)
    weights_m2 = power_weights(sites, np.array([rate for _, rate, _ in scene]), alpha=alpha)
    names = [str(number) for number in range(len(scene))]
    partition = Partition(names, sites, weights_m2)
    for own, name in enumerate(names):
        border = np.zeros(len(PLACES), np.uint8)
        cut(PLACES, border, sites, weights_m2, own)
        for widest in range(3):
            view = SensorViews.of(np.zeros((1, 2)), [partition.cell(name, widest, BOX)])
            inside = view.within(PLACES.astype(np.float64), 1000.0)
            assert np.mean(inside != (border <= widest)) < 0.002  # but on a border itself


def frame_of(*chunks: Chunk) -> Frame:
    agents = sorted({one.agent for one in chunks})
    return Frame(20, 20, agents, [], [*chunks], complete=True, first_ns=0, ready_ns=1)


def chunk(agent: str, index: int = 0, chunks: int = 1, plan: int = 9, **more: bool) -> Chunk:
    nothing = np.zeros((0, 3), np.float32)
    return Chunk(20, 20, agent, index, chunks, np.zeros(6), nothing, 0, plan_frame=plan, **more)


def planner_of(policy: str) -> Planner:
    """Returns a planner with plans for frames 2 to 9, in which `a` has x < 20 m, `b` the rest."""
    scenario = {"mode": "lockstep", "upload": {"policy": policy}}
    planner = Planner(scenario, PlanConfig(alpha=0.2), MAIN_AND_SIDE)
    for frame in range(8):
        for agent, x_m in (("a", 0.0), ("b", 40.0)):
            planner.sites.add(scan(frame, x_m, agent))
        planner.plans(replace(frame_of(), frame=frame, scanning=["a", "b"]))
    return planner


def rightmost_m(cell: np.ndarray) -> float:
    return float(cell[:, 0].max())


def test_chunks_by_a_plan_are_of_their_agents_cell_alone() -> None:
    cells = planner_of("voronoi").cells_of
    assert rightmost_m(cells(frame_of(chunk("a")))["a"]) == pytest.approx(20)
    assert cells(frame_of(chunk("b")))["b"][:, 0].min() == pytest.approx(20)
    assert cells(frame_of(chunk("a", plan=-1))) == {}  # all that it sees
    for unknown in (chunk("c"), chunk("a", plan=99)):
        assert len(cells(frame_of(unknown))[unknown.agent]) == 0


def test_chunk_by_chunk_more_is_known_and_at_last_all() -> None:
    cells = planner_of("reap").cells_of
    came = [chunk("a", index, 4) for index in range(4)]
    known_m = [rightmost_m(cells(frame_of(*came[: n + 1]))["a"]) for n in range(3)]
    assert known_m[0] < known_m[1] < known_m[2]
    assert known_m[1] == pytest.approx(20)
    assert cells(frame_of(*came)) == {}
    for many in (5, 64):  # of a plug-in's policy: the fourth is the whole rest
        assert cells(frame_of(*(chunk("a", index, many) for index in range(4)))) == {}
    lost = [replace(came[0], is_undecodable=True), *came[1:]]
    assert len(cells(frame_of(*lost))["a"]) == 0


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
