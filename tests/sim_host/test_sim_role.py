"""The sim role on in-process buses, with the other processes' messages."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from protocol import messages as m
from protocol.errors import BusError
from protocol.in_process import InProcessBus, InProcessRouter
from protocol.inbox import Envelope, Inbox
from protocol.process import Context
from protocol.topics import BusName
from sim_host.role import SimRole
from sim_host.setup import build_setup
from tests.waiting import TIMEOUT_S, wait_until

MAIN, SIDE = "rrrrrGGGGGGGG", "GGGGGrrrrrrrr"
M = TypeVar("M", bound=m.Message)
OTHERS = ("router", "edge-r0", "signal-r0", "record", "infra-r0", "vehicle-0", "vehicle-1")


class Rig:
    """A sim role and everybody else."""

    def __init__(self, run_dir: Path, mode: str, **more: object) -> None:
        scenario: dict[str, object] = {
            "seed": 1,
            "mode": mode,
            "duration_s": 0.5,
            "frame_period_s": 0.1,
            "traffic": {"warmup_s": 20, "cav_rate": 0.5, "start_timeout_s": 30},
            "cabinet": {},
            "scene": {},
            "roadside_mounts": [{"id": "rsu-0"}],
            "processes": {"vehicle": 2},
        }
        setup = build_setup({**scenario, **more}, run_dir)
        world, v2x = InProcessRouter(BusName.WORLD), InProcessRouter()
        self.inbox, self.seen = Inbox(), Inbox()
        self.stop = threading.Event()
        own_world, own_v2x = world.bus(self.inbox), v2x.bus(self.inbox)
        self.listener_world, self.listener_v2x = world.bus(self.seen), v2x.bus(self.seen)
        for topic in ("tick", "bodies", "truth", "trips", "end", "metrics"):
            self.listener_world.subscribe(topic)
        self.listener_v2x.subscribe("state")
        self.others: dict[str, list[InProcessBus]] = {}
        self.networks = (world, v2x)
        context = Context(
            "sim", setup, run_dir, own_world, own_v2x, self.inbox, self.stop, lambda: own_v2x
        )
        self.role = SimRole.build(context)

    def appear(self, *names: str) -> None:
        for name in names:
            self.others[name] = [network.bus(Inbox()) for network in self.networks]
            for bus in self.others[name]:
                bus.announce(name.split("-")[0], name)

    def vanish(self, name: str) -> None:
        for bus in self.others.pop(name):
            bus.close()

    def turn(self) -> list[m.Message]:
        """Lets the role handle all messages; returns what it published."""
        while (item := self.inbox.get()) is not None:
            self.role.on(item)
        self.role.poll()
        published = []
        while isinstance(item := self.seen.get(), Envelope):
            published.append(item.message)
        return published

    def until(self, holds: Callable[[list[m.Message]], bool]) -> list[m.Message]:
        """Turns until the messages published are those waited for."""
        published: list[m.Message] = []
        wait_until(lambda: published.extend(self.turn()) or holds(published))
        return published

    def until_frame(self) -> list[m.Message]:
        for _ in range(100):
            if published := self.turn():
                return published
        raise AssertionError("no frame began")

    def request(
        self, tick: m.Tick, state: str, delay_sim_ns: int | None = None, **other: object
    ) -> None:
        fields = {
            "frame": tick.frame,
            "sim_time_ns": tick.sim_time_ns,
            "tls": "J",
            "state": state,
            "policy": "test",
            "delay_sim_ns": delay_sim_ns,
        }
        request = m.SignalRequest.model_validate(fields | other)
        self.listener_v2x.publish("request", request, tls="J")

    def advise(self, tick: m.Tick, agent: str, speed_mps: float | None, frame: int = 0) -> None:
        advice = m.SpeedAdvice(
            frame=tick.frame + frame,
            sim_time_ns=tick.sim_time_ns,
            tls="J",
            agent=agent,
            speed_mps=speed_mps,
        )
        self.listener_v2x.publish("advice", advice, tls="J", agent=agent)


@pytest.fixture
def make(tmp_path: Path) -> Iterator[type[Rig]]:
    rigs: list[Rig] = []

    class Kept(Rig):
        def __init__(self, mode: str = "lockstep", **more: object) -> None:
            super().__init__(tmp_path, mode, **more)
            rigs.append(self)

    yield Kept
    for rig in rigs:
        for name in list(rig.others):
            rig.vanish(name)
        rig.role.close()


def only(published: list[m.Message], kind: type[M]) -> list[M]:
    return [message for message in published if isinstance(message, kind)]


def stages(metrics: list[m.Metrics]) -> list[str]:
    return [span.stage for one in metrics for span in one.spans]


def test_nothing_begins_before_all_are_there(make: type[Rig]) -> None:
    rig = make()
    rig.appear(*OTHERS[:-1])
    last = [network.bus(Inbox()) for network in rig.networks]
    last[0].announce("vehicle", OTHERS[-1])
    for _ in range(20):
        assert rig.turn() == []
    last[1].announce("vehicle", OTHERS[-1])
    assert only(rig.until_frame(), m.Tick)


def test_lockstep_plays_every_frame_on_its_request_and_ends(make: type[Rig]) -> None:
    rig = make()
    rig.appear(*OTHERS)
    published = rig.until_frame()
    for frame in range(5):
        [tick], [truth], [state] = (only(published, k) for k in (m.Tick, m.Truth, m.SignalState))
        assert tick.frame == truth.frame == state.frame == frame
        assert tick.sim_time_ns == truth.sim_time_ns == (200 + frame) * 100_000_000
        assert tick.bodies == len(truth.ids)
        assert {*tick.agents} == {n for n, k in zip(truth.ids, truth.equipment, strict=True) if k}
        assert rig.turn() == []  # waits
        rig.request(tick, MAIN)
        published = rig.turn()
        metrics = only(published, m.Metrics)
        assert {(one.process, one.frame) for one in metrics} == {("sim", frame)}
        assert stages(metrics) == ["actuate", "world"]
        assert metrics[-1].drops == {}
    [end], [trips] = only(published, m.End), only(published, m.Trips)
    assert (end.frames, end.reason) == (5, "finished")
    assert trips.frame == 4
    assert {trip.vehicle for trip in trips.trips} >= set(truth.ids)
    assert isinstance(published[-1], m.End)
    assert rig.stop.is_set()


def test_vehicles_with_radio_are_spread_and_move_when_a_process_dies(make: type[Rig]) -> None:
    rig = make()
    rig.appear(*OTHERS)
    [tick] = only(rig.until_frame(), m.Tick)
    assert tick.processes == ["vehicle-0", "vehicle-1"]
    assert len(tick.agents)
    assert (tick.equipment != m.Equipment.NONE).all()
    assert abs(np.subtract(*np.bincount(tick.hosts, minlength=2))) <= 1
    rig.vanish("vehicle-0")
    rig.request(tick, MAIN)
    [tick] = only(rig.turn(), m.Tick)
    assert tick.processes == ["vehicle-1"]
    assert set(tick.hosts.tolist()) == {0}


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ({"state": "G" * 13}, "conflict"),
        ({"state": "G"}, "wrong_length"),
        ({"state": "o" * 13}, "bad_alphabet"),
        ({"frame": 99}, "out_of_turn"),
        ({"sim_time_ns": 1 << 60}, "out_of_turn"),
        ({"sim_time_ns": 0}, "out_of_turn"),
    ],
)
def test_a_frame_waits_for_a_request_that_can_be_taken(
    make: type[Rig], bad: dict[str, object], reason: str
) -> None:
    rig = make()
    rig.appear(*OTHERS)
    [tick] = only(rig.until_frame(), m.Tick)
    rig.request(tick, **{"state": MAIN, **bad})
    assert rig.turn() == []
    rig.request(tick, MAIN)
    rig.request(tick, **{"state": MAIN, **bad})
    metrics = only(rig.turn(), m.Metrics)
    assert stages(metrics) == ["actuate", "world"]
    after = Counter({"request_out_of_turn": 1})
    assert metrics[-1].drops == after + Counter({f"request_{reason}": 1})


def test_a_run_that_hears_unsafe_requests_alone_ends_by_their_reason(make: type[Rig]) -> None:
    rig = make(cabinet={"request_timeout_s": 0.05})
    rig.appear(*OTHERS)
    [tick] = only(rig.until_frame(), m.Tick)
    rig.request(tick, "G" * 13)
    with pytest.raises(BusError, match=r"what the cabinet refuses \(1 conflict\)"):
        rig.until(lambda _: False)


def test_a_request_with_a_delay_acts_that_much_later_in_simulated_time(make: type[Rig]) -> None:
    rig = make(duration_s=1)
    rig.appear(*OTHERS)
    [tick] = only(rig.until_frame(), m.Tick)
    for frame in range(9):
        rig.request(tick, MAIN, delay_sim_ns=250_000_000)  # on a grid of 0.1 s
        published = rig.turn()
        acted = [one.frame for one in only(published, m.Metrics) if stages([one]) == ["actuate"]]
        assert acted == ([frame - 3] if frame >= 3 else [])
        [tick] = only(published, m.Tick)


def test_a_request_that_a_newer_one_has_overtaken_is_counted(make: type[Rig]) -> None:
    rig = make()
    rig.appear(*OTHERS)
    [tick] = only(rig.until_frame(), m.Tick)
    rig.request(tick, MAIN, delay_sim_ns=150_000_000)
    [tick] = only(rig.turn(), m.Tick)
    rig.request(tick, MAIN)
    published = rig.turn()
    assert [one.frame for one in only(published, m.Metrics) if stages([one]) == ["actuate"]] == [1]
    rig.request(only(published, m.Tick)[0], MAIN)
    assert only(rig.turn(), m.Metrics)[-1].drops == {"request_overtaken": 1}


def test_who_never_appears_is_named(make: type[Rig]) -> None:
    rig = make(traffic={"warmup_s": 0, "start_timeout_s": 0.05})
    rig.appear("edge-r0", "signal-r0", "infra-r0", "vehicle-1")
    with pytest.raises(BusError, match=r"record, vehicle-0 did not appear within .* 0\.05 s"):
        rig.until(lambda _: False)


def test_a_request_that_never_comes_ends_the_run(make: type[Rig]) -> None:
    rig = make(cabinet={"request_timeout_s": 0.05})
    rig.appear(*OTHERS)
    rig.until_frame()
    with pytest.raises(BusError, match="no request for frame 0"):
        rig.until(lambda _: False)
    [end] = [item.message for item in iter(rig.seen.get, None) if item.topic == "end"]
    assert (end.frames, end.reason) == (1, "failed")


def test_a_stop_is_quick_and_tells_the_journeys_under_way(make: type[Rig]) -> None:
    rig = make(traffic={"warmup_s": 7200})
    rig.appear(*OTHERS)
    start_ns = time.thread_time_ns()
    rig.turn()
    rig.vanish("record")
    rig.role.close()
    assert time.thread_time_ns() - start_ns < 1e9
    assert [item.message.reason for item in iter(rig.seen.get, None) if item.topic == "end"] == [
        "stopped"
    ]


def test_the_world_stays_until_the_recorder_has_left(make: type[Rig]) -> None:
    rig = make()
    rig.appear(*OTHERS)
    rig.until_frame()
    closing = threading.Thread(target=rig.role.close)
    closing.start()
    wait_until(lambda: (item := rig.seen.get()) is not None and item.topic == "end")
    assert closing.is_alive()
    rig.vanish("record")
    closing.join(TIMEOUT_S)
    assert not closing.is_alive()


def test_realtime_keeps_the_clock_without_any_request(make: type[Rig]) -> None:
    rig = make("realtime")
    rig.appear(*OTHERS)
    rig.until_frame()
    start_ns = time.monotonic_ns()
    published = rig.until(lambda _: rig.stop.is_set())
    assert 0.4 < (time.monotonic_ns() - start_ns) / 1e9 < 2
    assert [tick.frame for tick in only(published, m.Tick)] == [1, 2, 3, 4]
    assert only(published, m.End)[0].frames == 5
    assert {state.source for state in only(published, m.SignalState)} == {"plan"}


def test_realtime_acts_on_a_frames_request_once_and_at_once(make: type[Rig]) -> None:
    rig = make("realtime", traffic={"warmup_s": 0})
    rig.appear(*OTHERS)
    [tick] = only(rig.until_frame(), m.Tick)
    rig.request(tick, MAIN)
    rig.request(tick, SIDE)
    published = rig.until(lambda published: len(only(published, m.Metrics)) == 2)
    assert stages(only(published, m.Metrics)) == ["actuate", "world"]


def test_realtime_acts_on_a_true_request_amid_hostile_ones(make: type[Rig]) -> None:
    rig = make("realtime", traffic={"warmup_s": 0})
    rig.appear(*OTHERS)
    [tick] = only(rig.until_frame(), m.Tick)
    for ahead_ns in range(1, 2000):
        rig.request(tick, SIDE, sim_time_ns=tick.sim_time_ns + ahead_ns * 10**9)
    rig.request(tick, "G" * 13)
    rig.request(tick, SIDE, tls="K")
    rig.request(tick, MAIN)
    rig.request(tick, MAIN)
    published = rig.until(lambda published: "world" in stages(only(published, m.Metrics)))
    assert stages(only(published, m.Metrics)) == ["actuate", "world"]
    assert only(published, m.Metrics)[0].drops == {
        "request_from_the_future": 1999,
        "request_conflict": 1,
        "request_wrong_tls": 1,
    }
    assert only(published, m.Metrics)[1].drops["request_replayed"] == 1


ADVISING = {"policy": "predictive", "speed_advice": True, "advice_min_mps": 5}


def driving(truth: m.Truth) -> str:
    """Returns the agent on the main road that drives fast and is farthest from its stop bar."""
    rows = zip(truth.ids, truth.lanes, truth.speeds_mps, truth.equipment, strict=True)
    places = dict(zip(truth.ids, truth.lane_positions_m, strict=True))
    names = [name for name, lane, v, kind in rows if kind and v > 10 and "_in_" in lane]
    return min(names, key=places.__getitem__)


@pytest.mark.parametrize("is_on", [True, False])
def test_agents_follow_speed_advice_where_the_scenario_says_so(
    make: type[Rig], is_on: bool
) -> None:
    rig = make(duration_s=1, signal=ADVISING | {"speed_advice": is_on})
    rig.appear(*OTHERS)
    published = rig.until_frame()
    [tick], [truth] = only(published, m.Tick), only(published, m.Truth)
    agent = driving(truth)
    [bystander, *_] = [n for n, k in zip(truth.ids, truth.equipment, strict=True) if not k]
    speeds = []
    for _ in range(9):
        rig.advise(tick, agent, 6.0)
        rig.advise(tick, bystander, 6.0)
        rig.advise(tick, agent, 7.0, frame=1)
        rig.request(tick, MAIN)
        published = rig.turn()
        [tick], [truth] = only(published, m.Tick), only(published, m.Truth)
        speeds.append(truth.speeds_mps[truth.ids.index(agent)])
    assert (min(speeds) < 9) == is_on
    drops = only(published, m.Metrics)[-1].drops
    assert drops == ({"advice_unknown_agent": 9, "advice_out_of_turn": 9} if is_on else {})


def test_a_frame_waits_for_the_advice_that_its_request_counts(make: type[Rig]) -> None:
    rig = make(signal=ADVISING, cabinet={"request_timeout_s": 5})
    rig.appear(*OTHERS)
    published = rig.until_frame()
    [tick], [truth] = only(published, m.Tick), only(published, m.Truth)
    rig.advise(tick, driving(truth), 6.0)
    rig.request(tick, MAIN, advised=2)
    assert rig.turn() == []
    rig.advise(tick, "nobody", 6.0)
    assert len(only(rig.turn(), m.Tick)) == 1


def test_advice_that_never_comes_ends_the_run(make: type[Rig]) -> None:
    rig = make(signal=ADVISING, cabinet={"request_timeout_s": 0.05})
    rig.appear(*OTHERS)
    [tick] = only(rig.until_frame(), m.Tick)
    rig.request(tick, MAIN, advised=1)
    with pytest.raises(BusError, match="no complete speed advice for frame 0 for J"):
        rig.until(lambda _: False)
