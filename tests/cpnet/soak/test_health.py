"""Health checks of a soak: which frames count as right."""

from __future__ import annotations

import numpy as np
import pytest

from protocol import messages as m
from protocol.inbox import Envelope, Presence
from protocol.topics import BusName
from tests.soak.findings import Fault, Findings, Growth, by_victim, page, victims_of
from tests.soak.health import SETTLED_FRAMES, STEADY_FRAMES, Health

PROCESSES = {"edge", "vehicle-0"}


class Loop:
    """Publishes the messages of a loop, frame after frame; a frame's time is its number."""

    def __init__(self) -> None:
        self.health = Health(set(PROCESSES), {"rsu-0"})
        self.frame = 0
        for process in PROCESSES:
            self.presence(process, alive=True)
        self.publish("state", m.SignalState.model_construct(source="max_pressure"))

    def presence(self, process: str, *, alive: bool) -> None:
        for bus in BusName:
            self.health.take(Presence("role", process, alive, bus), 0)

    def publish(self, topic: str, message: m.Message) -> None:
        self.health.take(Envelope(topic, {}, message, 0, b""), self.frame)

    def play(self, agents: list[str], cavs: list[str], *, complete: bool = True) -> None:
        kinds, hosts = np.ones(len(cavs), np.uint8), np.zeros(len(cavs), np.int32)
        tick = {"frame": self.frame, "agents": cavs, "equipment": kinds, "hosts": hosts}
        counts = {"frame": self.frame, "agents": agents, "complete": complete}
        self.publish("tick", m.Tick.model_construct(**tick))
        self.publish("lanes", m.LaneCounts.model_construct(**counts))
        self.publish("request", m.SignalRequest.model_construct(frame=self.frame))
        self.frame += 1


@pytest.fixture
def loop() -> Loop:
    return Loop()


def test_all_is_right_since_the_first_of_enough_right_frames(loop: Loop) -> None:
    for _ in range(STEADY_FRAMES - 1):
        loop.play(["rsu-0"], [])
    assert loop.health.right_since_ns is None
    loop.play(["rsu-0"], [])
    assert loop.health.right_since_ns == 0


@pytest.mark.parametrize(
    "frame",
    [
        {"agents": [], "cavs": []},
        {"agents": ["rsu-0"], "cavs": [], "complete": False},
    ],
)
def test_a_frame_that_lacks_something_begins_it_anew(loop: Loop, frame: dict[str, object]) -> None:
    for _ in range(STEADY_FRAMES):
        loop.play(["rsu-0"], [])
    loop.play(**frame)  # type: ignore[arg-type]
    assert loop.health.right_since_ns is None
    for _ in range(STEADY_FRAMES):
        loop.play(["rsu-0"], [])
    assert loop.health.right_since_ns == STEADY_FRAMES + 1


def test_a_cav_is_awaited_once_it_has_settled(loop: Loop) -> None:
    for _ in range(SETTLED_FRAMES):
        loop.play(["rsu-0"], ["cav"])
    assert loop.health.right_since_ns is not None
    loop.play(["rsu-0"], ["cav"])
    assert loop.health.wrong == f"frame {SETTLED_FRAMES} lacks cav"
    loop.play(["cav", "rsu-0"], ["cav"])
    assert loop.health.wrong == ""


def test_who_is_missing_on_a_bus_makes_all_wrong_until_it_is_back(loop: Loop) -> None:
    loop.presence("edge", alive=False)
    for _ in range(STEADY_FRAMES):
        loop.play(["rsu-0"], [])
    assert loop.health.absent() == ["edge"]
    assert loop.health.wrong == "edge not there"
    loop.presence("edge", alive=True)
    for _ in range(STEADY_FRAMES):
        loop.play(["rsu-0"], [])
    assert loop.health.right_since_ns == STEADY_FRAMES


def test_while_the_signal_shows_its_plan_nothing_is_right(loop: Loop) -> None:
    loop.publish("state", m.SignalState.model_construct(source="plan"))
    for _ in range(STEADY_FRAMES):
        loop.play(["rsu-0"], [])
    assert loop.health.right_since_ns is None
    assert loop.health.wrong == "the signal shows its plan"


def test_a_frame_without_a_request_does_not_count(loop: Loop) -> None:
    for frame in range(2 * STEADY_FRAMES):
        counts = {"frame": frame, "agents": ["rsu-0"], "complete": True}
        loop.publish("lanes", m.LaneCounts.model_construct(**counts))
    assert loop.health.right_since_ns is None


def test_everybody_but_the_world_is_killed_about_as_often() -> None:
    victims = victims_of(["sim", "edge", "signal", "infra-r0"], 20, np.random.default_rng(1))
    counts = {name: victims.count(name) for name in set(victims)}
    assert counts.keys() == {"edge", "signal", "infra-r0"}
    assert set(counts.values()) <= {6, 7}


def test_the_page_names_what_is_not_as_it_must_be() -> None:
    found = Findings(
        minutes=1,
        faults=[Fault("edge", 7, 1.5), Fault("edge", 9, 3.5), Fault("signal", 11, None, "silence")],
        memory=[Growth("edge", 100, 180, 190), Growth("sim", 100, 101, 102)],
        frames=600,
        gaps=0,
        unsafe=[],
        damage=["lost"],
    )
    assert by_victim(found.faults)[0] == ("edge", 2, 2.5, 3.5)
    text = page(found, "scripts/soak")
    assert "1 of them right again within 3 s" in text
    for fault in (
        "edge at frame 9: right again after 3.50 s",
        "signal at frame 11: never right again (silence)",
        "edge grew from 100 to 180 MiB",
        "lost",
    ):
        assert f"- {fault}" in text
