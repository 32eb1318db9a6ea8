"""The whole loop: real processes, real Zenoh on loopback, real SUMO."""

import json
import os
import re
import signal
import sqlite3
import time
from collections import deque

import numpy as np
import pytest
import zenoh

from protocol.messages import Roster, SignalState
from protocol.topics import PREFIX
from protocol.wire import decode, encode
from recording.run import Run, differences
from recording.tables import PhaseRow
from studies.in_process import run_in_process
from tests.cpnet.commands import check_breakdown, children_of, free_ports, rows, wait_for_frames
from tests.hostile import Hostile
from tests.signal_safety import violations_of
from tests.waiting import wait_until

ROLES = ["router", "sim", "record", "edge-r0", "signal-r0", "infra-r0", "vehicle-0", "vehicle-1"]


def test_two_lockstep_runs_of_one_seed_are_the_same_row_for_row(shell, first_run):
    status, output = shell.up("--duration", "8", "--out", "second").finish()
    assert status == 0, output
    assert differences(first_run, shell.folder / "second") == []
    for table in ("detections", "counts", "phases", "trips", "truth"):
        assert rows(first_run, table) > 0, table


def test_another_number_of_vehicle_processes_gives_the_same_rows(shell, first_run):
    more = ("--duration", "8", "--out", "second", "--set", "processes.vehicle=1")
    status, output = shell.up(*more).finish()
    assert status == 0, output
    assert differences(first_run, shell.folder / "second") == []


def test_one_process_without_a_network_gives_the_same_rows(shell, first_run):
    alone = shell.folder / "alone"
    alone.mkdir()
    run_in_process(json.loads((first_run / "scenario.json").read_text()), alone)
    assert differences(first_run, alone) == []
    assert rows(alone, "sightings") > 0


def test_planned_uploads_are_the_same_row_for_row_whatever_the_processes(shell):
    reap = ("--duration=3", "--cav-rate=0.1", "--set=upload.policy=reap")
    filtered = (*reap, "--set=upload.filters=[foreground]")
    for name, more in (("first", ()), ("second", ("--set=processes.vehicle=1",))):
        status, output = shell.up(*filtered, *more, f"--out={name}").finish()
        assert status == 0, output
    assert differences(shell.folder / "first", shell.folder / "second") == []
    summary = json.loads(shell.run("report", "first", "--json")[1])
    assert summary["drops"] == 0
    assert len(summary["agents"]) > 2
    with sqlite3.connect(f"file:{shell.folder}/first/run.sqlite?mode=ro", uri=True) as database:
        chunks = "SELECT count(*) FROM uploads WHERE frame = ? AND agent = 'rsu-0'"
        assert [database.execute(chunks, [frame]).fetchone()[0] for frame in (0, 20)] == [1, 4]


@pytest.mark.parametrize("policy", ["objects", "pose"])
def test_a_run_whose_agents_send_no_points(shell, policy):
    arguments = ("--duration=1", "--cav-rate=0.1", f"--set=upload.policy={policy}", "--out=run")
    status, output = shell.up(*arguments).finish()
    assert status == 0, output
    summary = json.loads(shell.run("report", "run", "--json")[1])
    assert (summary["frames"], summary["frames_incomplete"], summary["drops"]) == (10, 0, 0)
    assert summary["detections_per_frame"]["true"] > 0


def test_planned_uploads_in_realtime_end_their_frames_early(shell):
    arguments = ("--mode=realtime", "--duration=5", "--cav-rate=0.1", "--set=upload.policy=reap")
    unhurried = ("--set=frame_period_s=0.2", "--set=edge.deadline_ms=160")
    arguments += (*unhurried, "--set=upload.filters=[foreground]", "--out=run")
    status, output = shell.up(*arguments).finish()
    assert status == 0, output
    summary = json.loads(shell.run("report", "run", "--json")[1])
    assert summary["frames"] == 25
    assert summary["frames_incomplete"] < 12


def test_roles_in_two_commands_joined_over_tcp_give_the_same_rows(shell, first_run):
    port = free_ports()
    here = shell.up(
        "--duration=8",
        "--out=here",
        "--only=router,sim,record,edge,signal",
        f"--listen=127.0.0.1:{port}",
    )
    there = shell.start("up", "--only=vehicle,infra", f"--connect=127.0.0.1:{port}", "--out=there")
    for command in (here, there):
        status, output = command.finish()
        assert status == 0, output
    assert differences(first_run, shell.folder / "here") == []


def test_the_edge_may_be_on_another_machine_than_the_world(shell, first_run):
    port = free_ports()
    v2x, world = f"v2x=127.0.0.1:{port}", f"world=127.0.0.1:{port + 1}"
    edge = shell.start(
        "up", "--only=router,edge", f"--listen={v2x}", f"--connect={world}", "--out=edge"
    )
    here = shell.up(
        "--duration=8",
        "--out=here",
        "--only=sim,record,signal,vehicle,infra",
        f"--listen={world}",
        f"--connect={v2x}",
    )
    for command in (here, edge):
        status, output = command.finish()
        assert status == 0, output
    assert differences(first_run, shell.folder / "here") == []


def test_a_death_on_the_other_machine_ends_the_run_here(shell):
    port = free_ports()
    here = shell.up(
        "--duration=600",
        "--out=here",
        "--only=router,sim,record,edge,signal",
        f"--listen=127.0.0.1:{port}",
    )
    there = shell.start("up", "--only=vehicle,infra", f"--connect=127.0.0.1:{port}", "--out=there")
    here.read_until("vehicles")
    os.kill(children_of(shell.folder / "there")["vehicle-0"], signal.SIGKILL)
    status, output = there.finish()
    assert (status, "vehicle-0 was killed by SIGKILL" in output) == (1, True), output
    status, output = here.finish()
    assert status == 1
    assert "left another machine before the run ended" in output


def test_virtual_links_give_the_same_rows_whatever_the_number_of_processes(shell):
    slow = ("--duration=4", "--link=lte-poor", "--set", "link.roadside_profile=500kbit,40ms")
    for out, processes in (("first", 1), ("second", 2)):
        spread = f"processes.vehicle={processes}"
        status, output = shell.up(*slow, "--out", out, "--set", spread).finish()
        assert status == 0, output
    assert differences(shell.folder / "first", shell.folder / "second") == []
    alone = shell.folder / "alone"
    alone.mkdir()
    run_in_process(json.loads((shell.folder / "first" / "scenario.json").read_text()), alone)
    assert differences(shell.folder / "first", alone) == []
    assert rows(shell.folder / "first", "uploads") == rows(alone, "uploads")
    drops = json.loads(shell.run("report", "first", "--json")[1])["drops_by_reason"]
    assert drops["edge-r0"]["late"] > 0
    with sqlite3.connect(f"file:{shell.folder}/first/run.sqlite?mode=ro", uri=True) as database:
        delays = database.execute("SELECT delay_sim_ns FROM requests").fetchall()
    # The deadline, unless all whose scans would be late left the frame out: their links are full.
    assert max(delay_ns for (delay_ns,) in delays) == 80_000_000
    assert sum(delay_ns == 80_000_000 for (delay_ns,) in delays) > len(delays) / 2
    check_breakdown(shell.folder / "first", exactly=True)


def test_emulated_links_delay_scans_and_nothing_else(shell):
    slow = ("--mode=realtime", "--duration=5", "--link=5mbit,80ms", "--set=edge.deadline_ms=90")
    status, output = shell.up(*slow, "--out=run").finish()
    assert status == 0, output
    assert children_of(shell.folder / "run") == {}
    with sqlite3.connect(f"file:{shell.folder}/run/run.sqlite?mode=ro", uri=True) as database:
        sql = "SELECT min(received_ns - encode_end_ns) FROM uploads WHERE agent {} 'rsu-0'"
        ((vehicle_ns,),) = database.execute(sql.format("<>")).fetchall()
        ((roadside_ns,),) = database.execute(sql.format("=")).fetchall()
    assert vehicle_ns > 40_000_000
    assert roadside_ns < 40_000_000
    check_breakdown(shell.folder / "run", exactly=False)


def test_the_page_of_a_run_names_the_command_that_makes_it(shell, first_run):
    pytest.importorskip("jinja2", reason="extra study")
    status, output = shell.run("report", str(first_run), "--html", "run.html")
    page = (shell.folder / "run.html").read_text("utf-8")
    assert (status, output) == (0, "wrote run.html\n")
    assert "cpnet up t_junction --" in page
    assert "traffic.warmup_s=30.0" in page
    assert len(page) < 6_000_000


def test_the_page_of_a_run_comes_as_markdown_with_pictures_too(shell, first_run):
    pytest.importorskip("polars", reason="extra study")
    status, output = shell.run("report", str(first_run), "--markdown", "run.md")
    page = (shell.folder / "run.md").read_text("utf-8")
    assert (status, output) == (0, "wrote run.md\n")
    pictures = re.findall(r"!\[.*\]\((run/run-\d+\.png)\)", page)
    assert len(pictures) > 5
    assert all((shell.folder / name).is_file() for name in pictures)


def test_the_report_has_its_stable_keys(shell, first_run):
    status, output = shell.run("report", str(first_run), "--json")
    summary = json.loads(output)
    assert status == 0
    assert summary["frames"] == 80
    assert summary["sim_duration_s"] == pytest.approx(8)
    assert summary["real_time_factor"] > 0
    assert summary["agents"]["rsu-0"].keys() >= {"frames", "bytes_per_frame", "mbps"}
    for stage in ("sense", "encode", "link", "decode", "merge", "detect", "end_to_end"):
        assert summary["latency_ms"][stage].keys() == {"p50", "p95", "p99"}
    assert summary["e_cvpr"].keys() == {"mean", "std"}
    assert summary["delay_s"]["mean"] is not None
    assert summary["vehicles"].keys() >= {"inserted", "finished", "teleported"}
    assert summary["phases"]["switches"] >= 0
    assert summary["drops"] == 0
    assert children_of(first_run) == {}


@pytest.mark.parametrize("victim", ROLES)
def test_a_killed_process_ends_the_run_within_5_s_by_name(shell, victim):
    command = shell.up("--duration", "600", "--out", "run", "--set=traffic.warmup_s=5")
    command.read_until("vehicles")
    run_dir = shell.folder / "run"
    wait_for_frames(command, run_dir)
    os.kill(children_of(run_dir)[victim], signal.SIGKILL)
    before_ns = time.monotonic_ns()
    status, output = command.finish()
    assert time.monotonic_ns() - before_ns < 5e9
    assert status == 1
    assert f"{victim} was killed by SIGKILL" in output
    assert children_of(run_dir) == {}
    assert rows(run_dir, "frames") > 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_ends_cleanly_with_its_summary(shell, number):
    command = shell.up("--duration", "600", "--out", "run")
    command.read_until("vehicles")
    command.process.send_signal(number)
    status, output = command.finish()
    assert status == 128 + number
    assert "E-CVPR" in output
    assert "Traceback" not in output
    assert children_of(shell.folder / "run") == {}
    assert rows(shell.folder / "run", "trips") > 0


def test_a_killed_relay_ends_the_run_by_name(shell):
    command = shell.up("--mode=realtime", "--duration=600", "--link=lte", "--out=run")
    command.read_until("vehicles")
    os.kill(children_of(shell.folder / "run")["relay-vehicle"], signal.SIGKILL)
    status, output = command.finish()
    assert status == 1
    assert "relay-vehicle was killed by SIGKILL" in output
    assert children_of(shell.folder / "run") == {}


def test_processes_end_when_their_supervisor_is_killed(shell):
    command = shell.up("--duration", "600", "--out", "run")
    command.read_until("vehicles")
    command.process.kill()
    command.finish()
    wait_until(lambda: not children_of(shell.folder / "run"))


def test_the_world_runs_on_the_clock_in_realtime_mode(shell):
    status, output = shell.up("--mode=realtime", "--duration=5", "--out=run").finish()
    assert status == 0, output
    summary = json.loads(shell.run("report", "run", "--json")[1])
    assert summary["frames"] == 50
    assert 0.5 < summary["real_time_factor"] < 1.05  # a loaded machine falls behind, none hurries


def rogue_on(port: int) -> zenoh.Session:
    """Opens a connection to a V2X bus, as any process can that reaches its port."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    return zenoh.open(config)


def test_bad_messages_are_counted_and_the_run_goes_on(shell):
    port = free_ports()
    command = shell.up("--duration=12", "--out=run", f"--listen=127.0.0.1:{port}")
    command.read_until("vehicles")
    rogue = rogue_on(port)
    good = encode(Roster(frame=0, process="x", agents=[], scanning=[]))
    other_version = good[:4] + b"\x09\x00" + good[6:]
    oversized = good[:12] + b"\xff\xff\xff\x7f"
    for data in (b"", b"garbage", good[:-3], other_version, oversized):
        rogue.put(f"{PREFIX}/r0/roster/rogue", data)
    rogue.close()
    status, output = command.finish()
    assert status == 0, output
    drops = json.loads(shell.run("report", "run", "--json")[1])["drops_by_reason"]
    assert drops["edge-r0"] == {"MessageError": 4, "VersionError": 1}


def test_a_flood_of_hostile_requests_shows_nothing_unsafe_and_stops_no_control(shell):
    port = free_ports()
    run_dir = shell.folder / "run"
    arguments = ("--mode=realtime", "--duration=600", f"--listen=127.0.0.1:{port}", "--out=run")
    command = shell.up(*arguments)
    command.read_until("vehicles")
    with Run(run_dir) as run:
        road_signal = run.setup.road_map.intersections[0].signal
    hostile = Hostile(road_signal, np.random.default_rng(3))
    rogue = rogue_on(port)
    states: deque[SignalState] = deque(maxlen=1)

    def receive(sample: zenoh.Sample) -> None:
        states.append(decode(bytes(sample.payload), SignalState))

    listening = rogue.declare_subscriber(f"{PREFIX}/signal/{road_signal.tls}/state", receive)
    command.wait_until(lambda: states, what="no signal state was received")
    sent, ends_ns = 0, states[0].sim_time_ns + 8e9  # a loaded machine slows the world's time down
    while states[0].sim_time_ns < ends_ns or sent < 5_000:
        assert command.process.poll() is None
        for _ in range(10):
            request = encode(hostile.any(states[0].sim_time_ns))
            rogue.put(f"{PREFIX}/signal/{road_signal.tls}/request", request)
            sent += 1
        time.sleep(0.005)
    ends_ns = states[0].sim_time_ns
    command.wait_until(
        lambda: states[0].source == "max_pressure" and states[0].sim_time_ns > ends_ns + 2e9,
        what="the controller never came back",
    )
    listening.undeclare()
    rogue.close()
    command.process.send_signal(signal.SIGINT)
    status, output = command.finish()
    assert status == 130, output
    with Run(run_dir) as run:
        assert violations_of(run) == []
        phases = list(run.rows(PhaseRow))
    summary = json.loads(shell.run("report", "run", "--json")[1])
    assert summary["frames"] == len(phases)
    drops = summary["drops_by_reason"]["sim"]
    for reason in (
        "wrong_tls", "wrong_length", "bad_alphabet", "no_green", "from_the_future", "stale",
        "replayed", "conflict",
    ):  # fmt: skip
        assert drops[f"request_{reason}"] > 0, reason
