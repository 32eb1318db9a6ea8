"""Vehicles follow speed advice that is valid and recent, and no other."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.messages import Equipment, Setup, SpeedAdvice
from sim_host import advised_speeds
from sim_host.advised_speeds import HELD_NS, AdvisedSpeeds, SpeedBounds
from sim_host.world import Ground, World

S = 1_000_000_000
NOW = 100 * S
MAIN, SIDE = "rrrrrGGGGGGGG", "GGGGGrrrrrrrr"


class Road:
    """Agents by their id, with the signals ahead of them, and their speed commands."""

    def __init__(self) -> None:
        self.ahead = {"a": {"J"}, "b": {"J", "K"}, "c": {"K"}}
        self.speeds: dict[str, float | None] = {}
        self.commands: list[tuple[str, float | None]] = []

    def signals_ahead(self, agent: str) -> set[str] | None:
        return self.ahead.get(agent)

    def set_speed(self, agent: str, speed_mps: float | None) -> None:
        assert agent in self.ahead
        self.speeds[agent] = speed_mps
        self.commands.append((agent, speed_mps))


class Rig:
    """Advice to those on a road, as a signal's process would send it."""

    def __init__(self, *, lockstep: bool = False) -> None:
        self.road = Road()
        bounds = SpeedBounds(least_mps=5.0, most_mps=20.0)
        self.advised = AdvisedSpeeds(self.road, {"J", "K"}, bounds, lockstep=lockstep)

    def advise(
        self,
        agent: str,
        speed_mps: float | None,
        at_ns: int = NOW,
        tls: str = "J",
        *,
        awaited: bool = True,
        now_ns: int = NOW,
        delay_ns: int | None = None,
        key: dict[str, str] | None = None,
    ) -> None:
        advice = SpeedAdvice(
            frame=0,
            sim_time_ns=at_ns,
            tls=tls,
            agent=agent,
            speed_mps=speed_mps,
            delay_sim_ns=delay_ns,
        )
        key = {"tls": tls, "agent": agent} if key is None else key
        self.advised.take(advice, key, now_ns, awaited=awaited)

    def refused(self) -> Counter[str]:
        return self.advised.drops()


def test_an_agent_drives_as_advised_until_it_is_free() -> None:
    rig = Rig()
    rig.advise("a", 8.0)
    assert rig.road.commands == []
    rig.advised.actuate(NOW)
    assert rig.road.speeds == {"a": 8.0}
    rig.advise("a", None, NOW + S, now_ns=NOW + S)
    rig.advised.actuate(NOW + S)
    assert rig.road.speeds == {"a": None}
    assert rig.advised.obeyed == 1
    assert rig.refused() == {}


def test_advice_that_is_not_renewed_ends_by_itself() -> None:
    rig = Rig()
    rig.advise("a", 8.0)
    for now_ns in (NOW, NOW + HELD_NS):
        rig.advised.actuate(now_ns)
        assert rig.road.speeds == {"a": 8.0}
    rig.advised.actuate(NOW + HELD_NS + 1)
    assert rig.road.speeds == {"a": None}


def test_whoever_has_passed_the_stop_bar_drives_freely() -> None:
    rig = Rig()
    rig.advise("b", 8.0)
    rig.advised.actuate(NOW)
    rig.road.ahead["b"] = {"K"}
    rig.advised.actuate(NOW + 1)
    assert rig.road.speeds == {"b": None}


def test_whoever_has_left_is_forgotten() -> None:
    rig = Rig()
    rig.advise("a", 8.0)
    rig.advise("b", 8.0)
    rig.advised.actuate(NOW)
    rig.advise("b", 7.0, NOW + 1, now_ns=NOW + 1)
    del rig.road.ahead["a"], rig.road.ahead["b"]
    rig.advised.actuate(NOW + 1)
    rig.advise("a", None, NOW + 2, now_ns=NOW + 2)
    rig.advised.actuate(NOW + 2)
    assert rig.road.commands == [("a", 8.0), ("b", 8.0)]
    assert rig.refused() == {}


def test_one_signal_does_not_end_what_another_advises() -> None:
    rig = Rig()
    rig.advise("b", 8.0, tls="K")
    rig.advise("b", None, tls="J")
    rig.advised.actuate(NOW)
    assert rig.road.speeds == {"b": 8.0}


def test_advice_over_a_virtual_link_acts_when_it_is_there() -> None:
    rig = Rig()
    rig.advise("a", 8.0, delay_ns=S // 4)
    rig.advised.actuate(NOW + S // 5)
    assert rig.road.commands == []
    rig.advised.actuate(NOW + S // 4)
    assert rig.road.commands == [("a", 8.0)]


@pytest.mark.parametrize(
    ("reason", "agent", "speed_mps", "more"),
    [
        ("unknown_agent", "nobody", 8.0, {}),
        ("bad_speed", "a", 4.99, {}),
        ("bad_speed", "a", 20.01, {}),
        ("passed", "c", 8.0, {}),
        ("wrong_tls", "a", 8.0, {"tls": "L"}),
        ("wrong_key", "a", 8.0, {"key": {"tls": "J", "agent": "b"}}),
        ("wrong_key", "a", 8.0, {"key": {"tls": "K", "agent": "a"}}),
        ("stale", "a", 8.0, {"at_ns": NOW - HELD_NS - 1}),
        ("from_the_future", "a", 8.0, {"at_ns": NOW + 1}),
    ],
)
def test_advice_that_cannot_be_right_is_counted_and_dropped(
    reason: str, agent: str, speed_mps: float, more: dict
) -> None:
    rig = Rig()
    rig.advise(agent, speed_mps, **more)
    rig.advised.actuate(NOW + S)
    assert rig.road.commands == []
    assert rig.refused() == {f"advice_{reason}": 1}


def test_advice_counts_once_and_older_one_not_at_all() -> None:
    rig = Rig()
    rig.advise("a", 8.0)
    rig.advise("a", 6.0)
    rig.advise("a", 6.0, NOW - 1)
    rig.advised.actuate(NOW)
    assert rig.road.commands == [("a", 8.0)]
    assert rig.refused() == {"advice_replayed": 2}


def test_in_lockstep_only_advice_of_the_present_frame_counts() -> None:
    rig = Rig(lockstep=True)
    rig.advise("a", 8.0, awaited=False)
    rig.advise("b", 8.0)
    rig.advised.actuate(NOW)
    assert rig.road.commands == [("b", 8.0)]
    assert rig.refused() == {"advice_out_of_turn": 1}


def test_so_much_advice_waits_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(advised_speeds, "MAX_PENDING_ADVICE", 3)
    rig = Rig()
    for number in range(5):
        rig.advise("a", 8.0, NOW + number, now_ns=NOW + number, delay_ns=S)
    assert rig.refused() == {"advice_crowded_out": 2}
    assert len(rig.advised._pending) == 3


any_advice = st.tuples(
    st.sampled_from(["a", "b", "c", "nobody"]),
    st.sampled_from(["J", "K"]),
    st.none() | st.floats(1.0, 25.0),
    st.integers(0, 5),
    st.sampled_from([None, 1, 2]),
)


@given(
    st.lists(any_advice, max_size=12, unique_by=lambda one: (one[0], one[1], one[3])), st.randoms()
)
def test_the_order_in_which_advice_arrives_is_no_matter(sent: list, random: object) -> None:
    found = []
    for _ in range(2):
        sent = sorted(sent, key=lambda one: one[3])
        rig = Rig()
        for step in range(8):
            now = [one for one in sent if one[3] == step]
            random.shuffle(now)
            for agent, tls, speed_mps, at, delay in now:
                rig.advise(agent, speed_mps, at, tls, now_ns=at, delay_ns=delay)
            rig.advised.actuate(step)
        found.append((rig.road.commands, rig.refused()))
        held = {name for name, speed_mps in rig.road.speeds.items() if speed_mps is not None}
        assert held == rig.advised._held.keys()
    assert found[0] == found[1]


@pytest.fixture
def world(setup: Setup, run_dir: Path, flat: Ground):
    made = World(setup, run_dir, flat)
    made.start(1)
    made.set_signal("J", MAIN)
    for _ in range(300):
        made.step()
    yield made
    made.close()


def speeds(world: World) -> dict[str, float]:
    bodies = world.bodies()
    return dict(zip(bodies.ids, bodies.speeds_mps.tolist(), strict=True))


def test_agents_alone_have_signals_ahead(world: World) -> None:
    bodies = world.bodies()
    for name, kind in zip(bodies.ids, bodies.equipment.tolist(), strict=True):
        assert (world.signals_ahead(name) is None) == (kind == Equipment.NONE)
    ahead = [world.signals_ahead(name) for name in bodies.ids]
    assert {"J"} in ahead
    assert set() in ahead  # it has passed


def test_a_vehicle_keeps_the_speed_it_is_told_and_then_drives_freely(world: World) -> None:
    lanes = dict(zip((found := world.bodies()).ids, found.lane_positions_m, strict=True))
    names = [n for n, v in speeds(world).items() if v > 10 and world.signals_ahead(n)]
    name = min(names, key=lanes.__getitem__)
    world.set_speed(name, 6.0)
    for _ in range(30):
        world.step()
    assert speeds(world)[name] == pytest.approx(6.0, abs=0.01)
    world.set_speed(name, None)
    for _ in range(40):
        world.step()
    assert speeds(world)[name] > 9


def test_a_vehicle_that_is_told_to_drive_stops_at_red_and_is_not_faster_than_it_would_be(
    world: World,
) -> None:
    world.set_signal("J", "r" * len(MAIN))
    for _ in range(60):
        world.step()
    waiting = [name for name in world.bodies().ids if world.signals_ahead(name)]
    assert len(waiting) > 5
    fastest_mps = 0.0
    for _ in range(200):
        for name in waiting:
            world.set_speed(name, 50.0)
        world.step()
        fastest_mps = max(fastest_mps, *speeds(world).values())
    assert all(world.signals_ahead(name) for name in waiting)
    assert fastest_mps < 1.3 * 13.9
    assert np.mean([speeds(world)[name] < 0.1 for name in waiting]) > 0.9


def test_whoever_has_arrived_is_no_agent_any_more(world: World) -> None:
    before = {name for name in world.bodies().ids if world.signals_ahead(name) is not None}
    arrived: set[str] = set()
    while not arrived:
        world.step()
        arrived = {name for name in before if world.signals_ahead(name) is None}
    assert not arrived & {*world.bodies().ids}
