"""A process that floods the V2X bus, on real Zenoh loopback: the others must not notice."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zenoh

from protocol.codec import encode_cloud
from protocol.messages import AgentPose, Equipment, Message, Roster, Scan
from protocol.scans import PointCloud
from protocol.topics import ALIVE, TOPICS
from protocol.wire import encode
from recording.run import differences
from tests.cpnet.commands import (
    SMALL,
    UNHURRIED,
    Shell,
    children_of,
    free_ports,
    query,
    wait_for_frames,
)

FLOODER, AGENTS = "flood-0", 300
FLOOD_S = 5.0
PAUSE_S = 0.001
FRAMES = 25  # two a second, which a machine can do that is shared with the flooder


def invented(frame: int) -> list[tuple[str, bytes]]:
    """Returns keys and bytes of a roster, and of poses and scans of agents that nobody knows."""
    names = [f"ghost-{n}" for n in range(AGENTS)]
    cloud = PointCloud(np.zeros((500, 3), np.float32), np.zeros(500, np.float32))
    payload = np.frombuffer(encode_cloud(cloud, 0.02), np.uint8)
    roster = Roster(frame=frame, process=FLOODER, agents=names, scanning=names)
    messages: list[tuple[str, dict[str, str], Message]] = [("roster", {}, roster)]
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
        messages += [("pose", {"agent": name}, pose), ("scan", {"agent": name, "chunk": "0"}, scan)]
    return [
        (TOPICS[topic].key(region="r0", process=FLOODER, **parts), encode(message))
        for topic, parts, message in messages
    ]


@contextmanager
def joined(port: int, *, shown: bool) -> Iterator[zenoh.Session]:
    """Context manager: a session; an announced one is present as a vehicle process."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    with zenoh.open(config) as session:
        if shown:
            token = session.liveliness().declare_token(f"{ALIVE}/vehicle/{FLOODER}")
        yield session
        if shown:
            token.undeclare()


def flood(
    session: zenoh.Session,
    messages: list[tuple[str, bytes]],
    per_s: int,
    is_over: Callable[[float], bool],
) -> int:
    """Publishes all messages repeatedly until it is over; returns how many messages that were."""
    begin_s, number, passed_s = time.monotonic(), 0, 0.0
    while not is_over(passed_s):
        for _ in range(max(int(passed_s * per_s) - number, 0)):
            session.put(*messages[number % len(messages)])
            number += 1
        time.sleep(PAUSE_S)  # until the next are due, the core is the run's
        passed_s = time.monotonic() - begin_s
    return number


def memory_mb(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def dropped(shell: Shell, run_dir: Path) -> dict[str, dict[str, int]]:
    """Returns how many messages each process dropped, by reason."""
    summary = json.loads(shell.run("report", str(run_dir), "--json")[1])
    return summary["drops_by_reason"]  # type: ignore[no-any-return]  # JSON


def test_a_flood_by_strangers_changes_no_row_of_a_run_in_lockstep(shell: Shell, first_run: Path):
    messages = [message for frame in range(0, 80, 8) for message in invented(frame)]
    port, run_dir = free_ports(), shell.folder / "run"
    command = shell.up("--duration=8", "--out=run", f"--listen=127.0.0.1:{port}")
    command.read_until("vehicles")
    with joined(port, shown=False) as session:
        number = flood(session, messages, 3_000, lambda _: command.process.poll() is not None)
    status, output = command.finish()
    assert status == 0, output
    assert number > 5_000
    assert dropped(shell, run_dir)["edge-r0"]["rate_limited"] > number / 10
    assert differences(first_run, run_dir) == []


def test_a_flood_by_a_process_costs_no_memory_and_the_run_recovers(shell: Shell) -> None:
    messages = [message for frame in range(4, 20, 2) for message in invented(frame)]
    port, run_dir = free_ports(), shell.folder / "run"
    realtime = ("--mode=realtime", f"--duration={FRAMES / 2}", "--out=run", *UNHURRIED)
    command = shell.up(*realtime, *SMALL, "--cav-rate=0.1", f"--listen=127.0.0.1:{port}")
    command.read_until("vehicles")
    wait_for_frames(command, run_dir)
    edge = children_of(run_dir)["edge-r0"]
    before_mb = memory_mb(edge)
    with joined(port, shown=True) as session:
        number = flood(session, messages, 10_000, lambda passed_s: passed_s > FLOOD_S)
        grown_mb = memory_mb(edge) - before_mb
    (newest,) = query(run_dir, "SELECT max(frame) FROM frames")[0]
    status, output = command.finish()
    assert status == 0, output
    drops = dropped(shell, run_dir)
    assert number > 5_000
    assert drops["edge-r0"]["rate_limited"] > number / 2
    assert "inbox_full" not in drops["edge-r0"] | drops["record"]
    assert grown_mb < 150
    after = "SELECT count(*), sum(complete) FROM frames WHERE frame > ?"
    frames, complete = query(run_dir, after, newest + 4)[0]
    assert complete > frames / 2
