"""A process that floods the V2X bus, on real Zenoh loopback: the others must not notice."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from protocol.codec import encode_cloud
from protocol.messages import AgentPose, Equipment, Message, Roster, Scan
from protocol.scans import PointCloud
from protocol.topics import ALIVE, TOPICS
from protocol.wire import encode
from tests.cpnet.commands import Shell, children_of, free_ports, wait_for_frames

FLOODER, AGENTS, PER_S = "flood-0", 300, 10_000
FLOOD_S = 4.0
FRAMES_PER_S = 5  # which a slow machine can do, of its own accord, beside the flooder
FRAMES = 50


def invented(frame: int) -> list[tuple[str, bytes]]:
    """Returns keys and bytes of a roster, and of poses and scans of agents that nobody knows."""
    names = [f"ghost-{n}" for n in range(AGENTS)]
    cloud = PointCloud(np.zeros((500, 3), np.float32), np.zeros(500, np.float32))
    payload = np.frombuffer(encode_cloud(cloud, 0.02), np.uint8)
    roster = Roster(frame=frame, process=FLOODER, agents=names, scanning=names)
    said: list[tuple[str, dict[str, str], Message]] = [("roster", {}, roster)]
    for name in names:
        pose = AgentPose(
            frame=frame,
            sim_time_ns=0,
            agent=name,
            equipment=Equipment.CAV,
            pose=np.zeros(6),
            length_m=4,
            width_m=2,
            height_m=2,
            position_std_m=0.1,
        )
        scan = Scan(
            frame=frame,
            sim_time_ns=0,
            agent=name,
            chunk=0,
            chunks=2,
            points=500,
            sensor_pose=np.zeros(6),
            sense_start_ns=0,
            sense_end_ns=0,
            encode_end_ns=0,
            payload=payload,
        )
        said += [("pose", {"agent": name}, pose), ("scan", {"agent": name, "chunk": "0"}, scan)]
    return [
        (TOPICS[topic].key(region="r0", process=FLOODER, **parts), encode(message))
        for topic, parts, message in said
    ]


@contextmanager
def joined(port: int) -> Iterator[zenoh.Session]:
    """Gives a session that has shown itself as a vehicle process and stays that long."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    session = zenoh.open(config)
    token = session.liveliness().declare_token(f"{ALIVE}/vehicle/{FLOODER}")
    yield session
    token.undeclare()
    session.close()


def flood(
    session: zenoh.Session, of_frame: list[list[tuple[str, bytes]]], newest: int, seconds: float
) -> int:
    """Says all that it can of the frames that follow; returns how many messages that were."""
    begin_ns = time.monotonic_ns()
    said, passed_s = 0, 0.0
    while passed_s < seconds:
        batch = of_frame[min(newest + 1 + int(passed_s * FRAMES_PER_S), len(of_frame) - 1)]
        for _ in range(max(int(passed_s * PER_S) - said, 0)):
            session.put(*batch[said % len(batch)])
            said += 1
        passed_s = (time.monotonic_ns() - begin_ns) / 1e9
    return said


def number(run_dir: Path, sql: str) -> int:
    with closing(sqlite3.connect(f"file:{run_dir}/run.sqlite?mode=ro", uri=True)) as database:
        found: int = database.execute(sql).fetchone()[0]
    return found


def memory_mb(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


@pytest.fixture
def flooded(shell: Shell) -> tuple[Path, int, float]:
    """Returns a realtime run that was flooded, by how many messages, and what that cost in MB."""
    of_frame = [invented(frame) for frame in range(FRAMES)]  # encoded beforehand: no time then
    port, run_dir = free_ports(), shell.folder / "run"
    realtime = ("--mode=realtime", f"--duration={FRAMES // FRAMES_PER_S}", "--out=run")
    pace = (f"--set=frame_period_s={1 / FRAMES_PER_S}", "--set=edge.deadline_ms=160")
    command = shell.up(*realtime, *pace, "--cav-rate=0.1", f"--listen=127.0.0.1:{port}")
    command.read_until("vehicles")
    wait_for_frames(command, run_dir)
    newest = number(run_dir, "SELECT max(frame) FROM frames")
    edge = children_of(run_dir)["edge-r0"]
    before_mb = memory_mb(edge)
    with joined(port) as session:
        said = flood(session, of_frame, newest, FLOOD_S)
        grown_mb = memory_mb(edge) - before_mb
        status, output = command.finish()
    assert status == 0, output
    return run_dir, said, grown_mb


def test_a_flood_costs_the_others_nothing(shell: Shell, flooded: tuple[Path, int, float]) -> None:
    run_dir, said, grown_mb = flooded
    summary = json.loads(shell.run("report", str(run_dir), "--json")[1])
    assert said > 5_000
    assert summary["drops_by_reason"]["edge-r0"]["rate_limited"] > said / 2
    assert "inbox_full" not in summary["drops_by_reason"]["edge-r0"]
    assert grown_mb < 150
    assert summary["frames"] == FRAMES
    assert summary["frames_incomplete"] < FRAMES / 2
    sql = "SELECT count(DISTINCT frame) FROM uploads WHERE agent = 'rsu-0' AND decoded_ns > 0"
    assert number(run_dir, sql) > 0.7 * FRAMES
