"""When a frame is complete, and when waiting ends."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import pytest

from edge_server import assembler as module
from edge_server.assembler import Assembler
from edge_server.completion import UploadProgress
from edge_server.frame import Chunk, Frame
from protocol.messages import AgentPose, Equipment, Objects, Roster, Scan

WAIT_NS = 1_000


def make(**more: str) -> Assembler:
    expected = {"vehicle-0": "vehicle", "infra-0": "infra"} | more
    made = Assembler(wait_ns=WAIT_NS, expected=expected)
    for name, role in expected.items():
        made.hear(name, role, alive=True)
    return made


def roster(process: str, agents: list[str], scanning: list[str], frame: int = 0) -> Roster:
    return Roster(frame=frame, process=process, agents=agents, scanning=scanning)


def pose(agent: str, frame: int = 0) -> AgentPose:
    return AgentPose(
        frame=frame,
        sim_time_ns=frame * 100,
        agent=agent,
        equipment=Equipment.CAV,
        pose=np.zeros(6),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=0.05,
    )


def chunk(agent: str, chunk: int = 0, chunks: int = 1, frame: int = 0) -> Chunk:
    points = np.zeros((10, 3), np.float32)
    return Chunk(frame, frame * 100, agent, chunk, chunks, np.zeros(6), points, 5, returns=10)


def give(to: Assembler, part: Roster | AgentPose | Chunk, at_ns: int = 5) -> None:
    match part:
        case Roster():
            to.add_roster(part, at_ns)
        case AgentPose():
            to.add_pose(part, at_ns)
        case Chunk():
            to.add_chunk(part)


def whole(frame: int = 0) -> list[Roster | AgentPose | Chunk]:
    return [
        roster("vehicle-0", ["b", "a"], ["a"], frame),
        roster("infra-0", ["rsu-0"], ["rsu-0"], frame),
        pose("b", frame),
        pose("a", frame),
        chunk("a", 1, 2, frame),
        chunk("a", 0, 2, frame),
        chunk("rsu-0", frame=frame),
    ]


def names(frame: Frame) -> tuple[list[str], list[str], list[tuple[str, int]]]:
    poses = [p.agent for p in frame.poses]
    return frame.agents, poses, [(p.agent, p.index) for p in frame.chunks]


def test_a_frame_is_whole_with_its_last_part_whichever_that_is() -> None:
    for last in range(7):
        parts = whole()
        parts.append(parts.pop(last))
        assembler = make()
        for part in parts[:-1]:
            give(assembler, part)
            assert assembler.pop(6) is None
        give(assembler, parts[-1])
        frame = assembler.pop(6)
        assert frame is not None
        assert frame.complete


def test_the_order_of_arrival_leaves_no_trace() -> None:
    seen = set()
    for parts in itertools.islice(itertools.permutations(whole()), 0, 5040, 211):
        assembler = make()
        for part in parts:
            give(assembler, part)
        frame = assembler.pop(6)
        assert frame is not None
        seen.add(str(names(frame)))
    expected = (["a", "b", "rsu-0"], ["a", "b"], [("a", 0), ("a", 1), ("rsu-0", 0)])
    assert seen == {str(expected)}


def test_a_process_that_dies_is_no_longer_waited_for() -> None:
    assembler = make(**{"vehicle-1": "vehicle"})
    for part in whole():
        give(assembler, part)
    assert assembler.pop(6) is None
    assembler.hear("vehicle-1", "vehicle", alive=False)
    frame = assembler.pop(6)
    assert frame is not None
    assert frame.complete


def test_what_a_dying_process_announced_is_not_waited_for() -> None:
    assembler = make()
    for part in whole()[:-1]:
        give(assembler, part)
    assembler.hear("infra-0", "infra", alive=False)
    frame = assembler.pop(6)
    assert frame is not None
    assert frame.agents == ["a", "b"]


def test_a_process_that_joins_is_waited_for_from_its_first_roster_on() -> None:
    assembler = make()
    assembler.hear("vehicle-1", "vehicle", alive=True)
    for part in whole():
        give(assembler, part)
    assert assembler.pop(6) is not None
    give(assembler, roster("vehicle-1", [], [], 1))
    for part in whole(1):
        give(assembler, part)
    assert assembler.pop(6) is not None
    for part in whole(2):
        give(assembler, part)
    assert assembler.pop(6) is None


def test_at_the_deadline_a_frame_is_used_as_far_as_it_came() -> None:
    assembler = make()
    for part in whole()[:-1]:
        give(assembler, part, at_ns=5)
    assert assembler.pop(5 + WAIT_NS) is None
    frame = assembler.pop(6 + WAIT_NS)
    assert frame is not None
    assert not frame.complete
    assert (frame.first_ns, frame.ready_ns) == (5, 6 + WAIT_NS)
    assert assembler.drops["frame_incomplete"] == 1


def test_what_comes_late_is_counted_and_dropped() -> None:
    assembler = make()
    for part in whole(3):
        give(assembler, part)
    frame = assembler.pop(6)
    assert frame is not None
    assert frame.frame == 3
    for part in whole(3)[:3]:
        give(assembler, part)
    give(assembler, chunk("a", frame=2))
    assert assembler.drops["late"] == 4
    assert assembler.pop(10 * WAIT_NS) is None


def test_the_newest_whole_frame_wins_and_older_ones_are_given_up() -> None:
    assembler = make()
    give(assembler, whole(0)[0])
    for number in (1, 2):
        for part in whole(number):
            give(assembler, part)
    frame = assembler.pop(6)
    assert frame is not None
    assert frame.frame == 2
    assert assembler.drops["frame_given_up"] == 2


def test_a_frame_without_agents_takes_its_time_from_the_signals_state() -> None:
    assembler = make()
    give(assembler, roster("vehicle-0", [], []))
    give(assembler, roster("infra-0", [], []))
    assert assembler.pop(6) is None
    assembler.add_time(0, 77)
    frame = assembler.pop(6)
    assert frame is not None
    assert (frame.agents, frame.sim_time_ns, frame.complete) == ([], 77, True)


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_AGENTS", 3)
    monkeypatch.setattr(module, "MAX_POINTS", 25)
    assembler = make()
    for number in range(10):
        give(assembler, pose("a", number))
    assert assembler.drops["frame_given_up"] == 6
    for agent in "abcd":
        give(assembler, pose(agent, 0))
    give(assembler, roster("vehicle-0", list("abcd"), [], 0))
    assert assembler.drops["too_many_agents"] == 2
    for agent in "abc":
        give(assembler, chunk(agent, frame=0))
    assert assembler.drops["frame_too_large"] == 1


def test_one_absurd_frame_number_neither_ends_a_frame_nor_makes_others_late() -> None:
    for absurd in (1 << 39, 70, 40):
        assembler = make()
        give(assembler, pose("ghost", absurd), at_ns=0)
        give(assembler, roster("vehicle-0", [], [], absurd), at_ns=0)
        assembler.add_time(absurd + 1, 9)
        for number in range(12):
            for part in whole(number):
                give(assembler, part)
            frame = assembler.pop(10 * WAIT_NS)
            assert frame is not None
            assert (frame.frame, frame.complete) == (number, True)
        give(assembler, pose("ghost", 1 << 39))
        assert assembler.drops["far_frame"] >= 1
        assert assembler.drops["late"] == 0


def test_an_edge_that_starts_in_mid_run_finds_in_by_the_signals_states() -> None:
    assembler = make()
    give(assembler, pose("ghost", 0))
    for number in range(500, 503):
        assembler.add_time(number, number * 100)
    for part in whole(502):
        give(assembler, part)
    frame = assembler.pop(6)
    assert frame is not None
    assert (frame.frame, frame.complete) == (502, True)


def test_agents_that_were_not_announced_make_room_for_those_that_were(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "MAX_AGENTS", 2)
    monkeypatch.setattr(module, "MAX_POINTS", 20)
    assembler = make()
    for agent in ("x", "y"):
        give(assembler, pose(agent))
        give(assembler, chunk(agent))
    give(assembler, roster("vehicle-0", ["a"], ["a"]))
    give(assembler, roster("infra-0", [], []))
    give(assembler, pose("a"))
    give(assembler, chunk("a"))
    frame = assembler.pop(6)
    assert frame is not None
    assert frame.complete
    assert assembler.drops["stranger_ousted"] == 2
    assert "a" in frame.agents


def test_a_process_that_is_not_there_is_not_waited_for_whatever_it_announces() -> None:
    assembler = make()
    give(assembler, roster("ghost", ["g"], ["g"]))
    for part in whole():
        give(assembler, part)
    assert assembler.pop(6) is not None
    assert assembler.drops["absent_process"] == 1


def chunk_of(agent: str, chunk: int = 0, chunks: int = 1, frame: int = 0) -> Scan:
    return Scan(
        frame=frame,
        sim_time_ns=0,
        agent=agent,
        chunk=chunk,
        chunks=chunks,
        points=0,
        sensor_pose=np.zeros(6),
        sense_start_ns=0,
        sense_end_ns=0,
        encode_end_ns=0,
        payload=np.zeros(0, np.uint8),
    )


def test_a_frame_ends_before_all_chunks_came_if_they_cover_the_scene() -> None:
    asked: list[Mapping[str, UploadProgress]] = []

    def covers(uploaded: Mapping[str, UploadProgress]) -> bool:
        asked.append(uploaded)
        return uploaded["a"].came >= 2

    expected = {"vehicle-0": "vehicle"}
    assembler = Assembler(wait_ns=WAIT_NS, expected=expected, covers=covers)
    assembler.hear("vehicle-0", "vehicle", alive=True)
    for part in (roster("vehicle-0", ["a"], ["a"]), chunk("a", 0, 4)):
        give(assembler, part)
        assert assembler.pop(6) is None
    assert asked == []  # without poses there is nothing to decide
    give(assembler, pose("a"))
    give(assembler, chunk("a", 2, 4))  # a gap before it
    assert assembler.pop(6) is None
    give(assembler, chunk("a", 1, 4))
    frame = assembler.pop(6)
    assert frame is not None
    assert frame.complete
    assert [uploaded["a"].came for uploaded in asked] == [1, 3]
    assert not assembler.wants(chunk_of("a", 3, 4), 7)
    assert not +assembler.drops


def test_boxes_that_an_agent_found_stand_for_its_scan() -> None:
    assembler = make()
    objects = Objects(
        frame=0,
        sim_time_ns=0,
        agent="rsu-0",
        boxes=np.zeros((2, 7), np.float32),
        scores=np.zeros(2, np.float32),
        classes=np.zeros(2, np.uint8),
        sense_start_ns=0,
        sense_end_ns=0,
        detect_end_ns=0,
    )
    for part in whole()[:-1]:
        give(assembler, part)
    assembler.add_objects(objects, 6)
    assembler.add_objects(objects, 6)
    assert +assembler.drops == {"duplicate": 1}
    frame = assembler.pop(6)
    assert frame is not None
    assert [one.objects for one in frame.found] == [objects]
    assert frame.agents == ["a", "b", "rsu-0"]
    assert frame.scanning == ["a", "rsu-0"]


def test_a_chunk_that_is_being_opened_is_wanted_no_second_time() -> None:
    assembler = make()
    scan = chunk_of("a", 0, 2)
    assert assembler.wants(scan, 5)
    assembler.begin(scan)
    assert not assembler.wants(scan, 5)
    assert not assembler.wants(chunk_of("a", 1, 3), 5)
    assert assembler.wants(chunk_of("a", 1, 2), 5)
    assert +assembler.drops == {"duplicate": 1, "contradiction": 1}


def test_a_frame_whose_time_is_over_waits_for_what_is_being_opened_and_for_no_more() -> None:
    assembler = make()
    for part in whole()[:-1]:
        give(assembler, part)
    scan = chunk_of("rsu-0")
    assert assembler.wants(scan, 5)
    assembler.begin(scan)
    assert assembler.pop(6 + WAIT_NS) is None
    assert not assembler.wants(chunk_of("a", 2, 3), 6 + WAIT_NS)
    assert +assembler.drops == {"late": 1}
    give(assembler, chunk("rsu-0"))
    frame = assembler.pop(7 + WAIT_NS)
    assert frame is not None
    assert frame.complete
    assert frame.agents == ["a", "b", "rsu-0"]


def test_a_scan_that_could_not_be_opened_holds_no_frame_up() -> None:
    assembler = make()
    for part in whole()[:-1]:
        give(assembler, part)
    scan = chunk_of("rsu-0")
    assembler.begin(scan)
    assert assembler.pop(6 + WAIT_NS) is None
    assembler.forgo(scan)
    frame = assembler.pop(6 + WAIT_NS)
    assert frame is not None
    assert not frame.complete


def test_a_whole_frame_does_not_wait_for_what_nobody_announced() -> None:
    assembler = make()
    stranger = chunk_of("ghost")
    assembler.begin(stranger)  # of a frame of which nothing came
    for part in whole():
        give(assembler, part)
    assembler.begin(stranger)
    assert assembler.pop(6) is not None
    give(assembler, chunk("ghost"))
    assembler.forgo(stranger)
    assert +assembler.drops == {"late": 1}


def test_a_process_that_floods_is_not_waited_for_until_its_next_roster() -> None:
    edge = make()
    for part in whole():
        if not isinstance(part, Roster) or part.process == "infra-0":
            give(edge, part)
    assert edge.pop(6) is None
    edge.wait_not_for({"vehicle-0", "nobody"})
    assert edge.pop(6) is not None
    give(edge, roster("vehicle-0", ["a"], [], frame=1))
    give(edge, roster("infra-0", [], [], frame=1))
    edge.add_time(1, 100)
    assert edge.pop(6) is None
    give(edge, pose("a", frame=1))
    assert edge.pop(6) is not None
