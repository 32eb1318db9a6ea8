"""Sensor sites, whatever the order of messages."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from edge_server.planner import MAX_SITES, SITE_AGE_FRAMES, SensorSites
from protocol.messages import AgentPose, Equipment, Scan


def pose(frame: int, x: float, agent: str = "a") -> AgentPose:
    return AgentPose(
        frame=frame,
        sim_time_ns=frame,
        agent=agent,
        equipment=Equipment.CAV,
        pose=np.array([x, 0, 0, 0, 0, 0]),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=0.05,
    )


def scan(frame: int, x: float, agent: str = "a") -> Scan:
    return Scan(
        frame=frame,
        sim_time_ns=frame,
        agent=agent,
        chunk=0,
        chunks=1,
        points=0,
        sensor_pose=np.array([x, 0, 3, 0, 0, 0]),
        sense_start_ns=1,
        sense_end_ns=2,
        encode_end_ns=3,
        payload=np.zeros(1, np.uint8),
    )


def test_the_newest_scan_tells_whatever_the_order_of_messages() -> None:
    for messages in permutations([pose(1, 1.0), scan(1, 1.1), pose(2, 2.0), scan(2, 2.1)]):
        sites = SensorSites()
        for message in messages:
            sites.add(message)
        site = sites.of(["a"], 2)["a"]
        assert (site.place[0], site.drives) == (2.1, True)


def test_a_post_says_no_pose_and_does_not_drive() -> None:
    sites = SensorSites()
    sites.add(scan(1, 5.0))
    assert not sites.of(["a"], 1)["a"].drives


def test_who_fell_silent_is_forgotten_and_strangers_find_no_room() -> None:
    sites = SensorSites()
    for number in range(MAX_SITES + 1):
        sites.add(pose(1, 0.0, f"agent {number}"))
    sites.add(pose(1 + SITE_AGE_FRAMES, 1.0, "agent 0"))
    assert f"agent {MAX_SITES}" not in sites.of([f"agent {MAX_SITES}"], 1)
    later = sites.of(["agent 0", "agent 1"], 2 + SITE_AGE_FRAMES)
    assert list(later) == ["agent 0"]
