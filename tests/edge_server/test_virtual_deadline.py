"""Messages that arrive too late over virtual links are left out, whatever the wall clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.completion import VirtualDeadline
from edge_server.config import EdgeConfig
from edge_server.frame import Chunk, Frame
from edge_server.scenario import virtual_deadline
from protocol.messages import NEVER_NS, AgentPose, Equipment

MS = 1_000_000
NOW = 5_000 * MS
RULE = VirtualDeadline(deadline_ns=80 * MS, compute_ns=3 * MS)


def pose(agent: str, after_ms: int | None) -> AgentPose:
    return AgentPose(
        frame=1,
        sim_time_ns=NOW,
        agent=agent,
        equipment=Equipment.CV,
        pose=np.zeros(6),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=0.05,
        arrival_sim_ns=None if after_ms is None else NOW + after_ms * MS,
    )


def chunk(agent: str, chunk: int, after_ms: int) -> Chunk:
    points = np.zeros((1, 3), np.float32)
    made = Chunk(1, NOW, agent, chunk, 2, np.zeros(6), points, 5)
    return replace(made, arrival_sim_ns=NOW + after_ms * MS)


def frame(poses: list[AgentPose], chunks: list[Chunk]) -> Frame:
    agents = sorted({part.agent for part in poses} | {part.agent for part in chunks})
    return Frame(1, NOW, agents, poses, chunks, complete=True, first_ns=1, ready_ns=2)


def test_a_frame_takes_as_long_as_its_last_arrival_and_the_computing() -> None:
    cut, late = RULE.cut(frame([pose("a", 10)], [chunk("a", 0, 80), chunk("b", 0, 20)]))
    assert (late, cut.complete, cut.delay_sim_ns) == (0, True, 83 * MS)
    assert cut.agents == ["a", "b"]


def test_what_is_late_is_left_out_and_the_deadline_counts() -> None:
    whole = frame([pose("a", 10), pose("c", 90)], [chunk("a", 0, 20), chunk("a", 1, 81)])
    cut, late = RULE.cut(whole)
    assert (late, cut.complete, cut.delay_sim_ns) == (2, False, 83 * MS)
    assert cut.agents == ["a"]
    assert [p.index for p in cut.chunks] == [0]


def test_a_frame_of_nobody_takes_the_computing_alone() -> None:
    cut, late = RULE.cut(frame([], []))
    assert (late, cut.complete, cut.delay_sim_ns) == (0, True, 3 * MS)


def test_what_names_no_arrival_came_at_once() -> None:
    cut, late = RULE.cut(frame([pose("a", None)], []))
    assert (late, cut.delay_sim_ns) == (0, 3 * MS)


@pytest.mark.parametrize(
    ("mode", "link", "expected"),
    [
        ("lockstep", {}, None),
        ("lockstep", {"profile": "lte", "edge_compute_ms": 3}, RULE),
        ("realtime", {"profile": "lte"}, None),
    ],
)
def test_only_virtual_links_have_this_rule(mode: str, link: object, expected: object) -> None:
    assert virtual_deadline({"mode": mode, "link": link}, EdgeConfig()) == expected


def test_chunks_are_needed_only_until_they_cover_the_scene() -> None:
    parts = [chunk("a", 0, 20), chunk("a", 1, 90), chunk("b", 0, 40), chunk("b", 1, 60)]
    whole = replace(frame([pose("a", 30)], parts), scanning=["a", "b"])
    cut, late = RULE.cut(whole, lambda came: sum(scan.came for scan in came.values()) == 3)
    assert (late, cut.complete, cut.delay_sim_ns) == (0, True, 63 * MS)
    assert [(p.agent, p.index) for p in cut.chunks] == [("a", 0), ("b", 0), ("b", 1)]
    assert RULE.end_ns(cut) == NOW + 60 * MS


def test_a_frame_waits_for_the_deadline_if_what_is_missing_never_comes() -> None:
    parts = [chunk("a", 0, 20), replace(chunk("a", 1, 0), arrival_sim_ns=NEVER_NS)]
    whole = replace(frame([], parts), scanning=["a"])
    cut, late = RULE.cut(whole, lambda came: came["a"].is_whole)
    assert (late, cut.complete, cut.delay_sim_ns) == (0, False, 83 * MS)
