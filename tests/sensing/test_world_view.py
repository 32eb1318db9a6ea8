"""The world as an agent process sees it: by tiles, whatever comes late or not at all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.in_process import InProcessBus, InProcessRouter
from protocol.inbox import Envelope, Inbox
from protocol.messages import Equipment, Tick, TileBodies, TileRequest
from protocol.tiles import TILE_M, tiles_of, tiles_within
from protocol.topics import BusName
from sensing.world_view import Surroundings, WorldView
from sim_host.presence import Fleet
from sim_host.ticks import TickPublisher
from sim_host.world import TrafficState

REACH_M = 130.0
PROCESS = "vehicle-0"


def traffic(*bodies: tuple[str, float, float], cavs: tuple[str, ...] = ()) -> TrafficState:
    """Returns bodies (id, x, y), sorted as the simulator does."""
    rows = sorted(bodies)
    return TrafficState(
        ids=[row[0] for row in rows],
        types=["car"] * len(rows),
        lanes=[""] * len(rows),
        poses=np.array([[x, y, 0, 0, 0, 0] for _, x, y in rows], np.float64).reshape(-1, 6),
        speeds_mps=np.zeros(len(rows), np.float32),
        lane_positions_m=np.zeros(len(rows), np.float32),
        equipment=np.array([Equipment.CAV * (r[0] in cavs) for r in rows], np.uint8),
    )


class Run:
    """A publisher and one process that follows it."""

    def __init__(self) -> None:
        network = InProcessRouter(BusName.WORLD)
        self.requests, self.received = Inbox(), Inbox()
        self.sim, self.mine = network.bus(self.requests), network.bus(self.received)
        self.sim.subscribe("tiles")
        self.mine.subscribe("tick")
        self.ticks = TickPublisher(self.sim)
        self.fleet = Fleet()
        self.fleet.join(PROCESS)
        self.around = Surroundings(self.mine, PROCESS, REACH_M)
        self.tick: Tick | None = None
        self.tiles_received = 0

    def receive(self) -> None:
        while isinstance(item := self.received.get(), Envelope):
            if isinstance(item.message, TileBodies):
                self.tiles_received += 1
                self.around.take(item.message)
            elif isinstance(item.message, Tick):
                self.tick = item.message
                self.around.begin(item.message)

    def answer(self) -> int:
        """Lets the simulator answer; returns how many requests there were."""
        count = 0
        while isinstance(item := self.requests.get(), Envelope):
            assert isinstance(item.message, TileRequest)
            self.ticks.answer(item.message)
            count += 1
        return count

    def frame(self, number: int, bodies: TrafficState) -> WorldView:
        self.ticks.publish(number, number * 10**9, bodies, self.fleet)
        self.receive()
        if not self.around.is_complete():
            assert self.answer() == 1
            self.receive()
        assert self.around.is_complete()
        assert self.tick is not None
        return self.around.view(self.tick)


@pytest.fixture
def run() -> Run:
    return Run()


def test_a_process_that_plays_nobody_hears_of_no_body(run: Run) -> None:
    view = run.frame(0, traffic(("a", 10, 10)))
    assert view.ids == []
    assert view.hosted == {}
    assert run.tiles_received == 0


def test_a_newcomer_sees_all_that_its_lidar_reaches_in_its_first_frame(run: Run) -> None:
    bodies = traffic(("b", 10, 10), ("a", 120, 10), ("far", 900, 900), cavs=("b",))
    view = run.frame(0, bodies)
    assert view.ids == ["a", "b"]
    assert view.hosted == {1: Equipment.CAV}
    assert view.poses[:, 0].tolist() == [120, 10]


def test_what_stands_still_is_not_sent_again(run: Run) -> None:
    still = traffic(("a", 10, 10), cavs=("a",))
    views = [run.frame(n, still) for n in range(4)]
    assert run.tiles_received == 1
    assert [view.ids for view in views] == [["a"]] * 4
    assert run.frame(4, traffic(("a", 11, 10), cavs=("a",))).poses[0, 0] == 11
    assert run.tiles_received == 2


def test_who_leaves_a_tile_is_gone_and_comes_back(run: Run) -> None:
    me = ("me", 100.0, 100.0)
    assert run.frame(0, traffic(me, ("a", 210, 100), cavs=("me",))).ids == ["a", "me"]
    assert run.frame(1, traffic(me, cavs=("me",))).ids == ["me"]
    assert run.frame(2, traffic(me, ("a", 210, 100), cavs=("me",))).ids == ["a", "me"]


def test_a_tile_that_was_lost_is_asked_for(run: Run) -> None:
    run.frame(0, traffic(("a", 10, 10), cavs=("a",)))
    run.ticks.publish(1, 10**9, traffic(("a", 12, 10), cavs=("a",)), run.fleet)
    while isinstance(item := run.received.get(), Envelope):
        if isinstance(item.message, Tick):  # the bodies got lost
            run.tick = item.message
            run.around.begin(item.message)
    assert not run.around.is_complete()
    assert run.answer() == 1
    run.receive()
    assert run.around.is_complete()
    assert run.tick is not None
    assert run.around.view(run.tick).poses[0, 0] == 12


def test_a_body_in_a_newer_tile_and_an_older_one_stands_in_the_newer(run: Run) -> None:
    run.frame(0, traffic(("me", 100, 100), ("a", 190, 100), ("b", 210, 100), cavs=("me",)))
    late = TileBodies(
        frame=7,
        column=1,
        row=0,
        ids=["a"],
        types=["car"],
        poses=np.array([[205.0, 100, 0, 0, 0, 0]]),
        speeds_mps=np.ones(1, np.float32),
    )
    run.around.take(late)
    assert run.tick is not None
    view = run.around.view(run.tick)
    assert view.ids == ["a", "me"]
    assert view.poses[0, 0] == 205


def test_tiles_far_behind_are_left(run: Run) -> None:
    for n, x in enumerate(range(0, 3000, 20)):
        run.frame(n, traffic(("a", x, 0), cavs=("a",)))
    assert isinstance(run.mine, InProcessBus)
    assert len([one for one in run.mine._own if one[0] == "bodies"]) <= 12


places = st.tuples(st.floats(-900, 900), st.floats(-900, 900))


@given(st.lists(st.lists(places, min_size=1, max_size=12), min_size=1, max_size=5), st.data())
def test_each_agent_finds_all_within_reach_in_every_frame(
    frames: list[list[tuple[float, float]]], data: st.DataObject
) -> None:
    run = Run()
    for number, spots in enumerate(frames):
        names = [f"v{n}" for n in range(len(spots))]
        cavs = tuple(data.draw(st.sets(st.sampled_from(names))))
        rows = [(name, *spot) for name, spot in zip(names, spots, strict=True)]
        bodies = traffic(*rows, cavs=cavs)
        view = run.frame(number, bodies)
        assert [view.ids[n] for n in view.hosted] == sorted(cavs)
        where = dict(zip(view.ids, view.poses[:, :2].tolist(), strict=True))
        assert all(where[name] == [*spot] for name, *spot in rows if name in where)
        for cav in cavs:
            x, y = spots[int(cav[1:])]
            near = {n for n, *s in rows if np.hypot(s[0] - x, s[1] - y) <= REACH_M}
            assert near <= set(view.ids)


@given(st.lists(places, min_size=1, max_size=6), st.floats(0, 500))
def test_tiles_within_reach_hold_every_place_that_near(
    spots: list[tuple[float, float]], reach_m: float
) -> None:
    tiles = tiles_within(np.array(spots), reach_m)
    for x, y in spots:
        for angle in np.linspace(0, 2 * np.pi, 13):
            place = np.array([[x + reach_m * np.cos(angle), y + reach_m * np.sin(angle)]])
            off = place - np.sign(place - [x, y]) * 1e-6  # what rounding does at an edge
            assert {tuple(t) for t in tiles_of(np.concatenate([place, off])).tolist()} & tiles
    assert len(tiles) <= len(spots) * (2 * reach_m / TILE_M + 2) ** 2
