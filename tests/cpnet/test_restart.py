"""`cpnet up --restart`: processes die and come back while the world goes on."""

import json
import os
import signal
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from cpnet.endpoints import free_locator
from cpnet.supervisor import FIRST_PAUSE_NS, LIST_NAME, MAX_RESTARTS, WITHIN_NS, Restarts
from protocol.bus import Endpoint
from tests.cpnet.commands import Command, Shell, children_of
from tests.soak.campaign import hurt_once
from tests.soak.findings import look_back, processes_of
from tests.soak.health import Health, Observer
from tests.waiting import TIMEOUT_S, wait_until

REALTIME = ("--mode=realtime", "--restart", "--set=edge.deadline_ms=300")


@contextmanager
def observed(shell: Shell, *more: str) -> Iterator[tuple[Command, Observer, Path]]:
    """Starts a run and yields it once all is right."""
    places = {bus: free_locator() for bus in ("v2x", "world")}
    listen = [f"--listen={bus}={place.removeprefix('tcp/')}" for bus, place in places.items()]
    command = shell.up(*REALTIME, *listen, "--duration=600", "--out=run", *more)
    run_dir = shell.folder / "run"
    command.wait_until(lambda: (run_dir / LIST_NAME).is_file())
    health = Health(set(processes_of(run_dir)), {"rsu-0"})
    buses = [Endpoint(place, listen=False) for place in places.values()]
    with Observer(*buses, health) as observer:
        assert observer.listen(TIMEOUT_S, observer.is_right), health.wrong
        yield command, observer, run_dir


def stop(command: Command) -> None:
    command.process.send_signal(signal.SIGINT)
    status, output = command.finish()
    assert status == 130, output


def test_whoever_dies_comes_back_and_all_is_right_again(shell):
    victims = ["record", "edge-r0", "signal-r0", "vehicle-0", "infra-r0", "record"]
    with observed(shell) as (command, observer, run_dir):
        faults = []
        for victim in victims:
            faults.append(hurt_once(observer, run_dir, victim, timeout_s=TIMEOUT_S))
            assert faults[-1].recovery_s is not None, faults[-1]
        asked = set(observer.asked)
    stop(command)
    found = look_back(run_dir, 1.0, faults, [], asked)
    assert (found.unsafe, found.damage, found.gaps) == ([], [], 2)
    assert children_of(run_dir) == {}


def fork_server_of(command: Command) -> int:
    children = Path(f"/proc/{command.process.pid}/task/{command.process.pid}/children")
    return next(
        int(number)
        for number in children.read_text().split()
        if b"forkserver" in Path(f"/proc/{number}/cmdline").read_bytes()
    )


def test_a_run_outlives_its_fork_server_and_has_no_twins(shell):
    with observed(shell) as (command, observer, run_dir):
        before = processes_of(run_dir)
        os.kill(fork_server_of(command), signal.SIGKILL)
        command.read_until("fork-server was killed")
        fault = hurt_once(observer, run_dir, "record", timeout_s=TIMEOUT_S)
        assert fault.recovery_s is not None, fault
        after = processes_of(run_dir)
        assert {name for name in before if before[name] != after[name]} == {"record"}
        # one look may miss a process on a full machine; a recorder that died stays missing
        command.wait_until(lambda: children_of(run_dir) == after)
    stop(command)
    assert children_of(run_dir) == {}


def test_who_is_stopped_is_told_of_and_starts_again(shell):
    with observed(shell) as (command, observer, run_dir):
        os.kill(processes_of(run_dir)["infra-r0"], signal.SIGSTOP)
        command.read_until("nothing heard from infra-r0: it is stopped")
        command.read_until("infra-r0 was stopped (SIGSTOP) for 5 s; started again")
        observer.health.reset()
        assert observer.listen(TIMEOUT_S, observer.is_right), observer.health.wrong
    stop(command)


def test_without_restart_the_fork_servers_death_ends_the_run(shell):
    command = shell.up("--duration=600", "--out=run")
    command.read_until("vehicles")
    os.kill(fork_server_of(command), signal.SIGKILL)
    status, output = command.finish()
    assert (status, "fork-server was killed" in output) == (1, True), output
    assert children_of(shell.folder / "run") == {}


def test_a_lost_agents_cavs_move_to_the_others_and_newcomers_join(shell):
    with observed(shell) as (command, observer, _):
        place = command.arguments
        buses = [word.removeprefix("--listen=") for word in place if "--listen=" in word]
        connect = [f"--connect={bus}" for bus in buses]
        joined = shell.start("up", "--only=vehicle-7", *connect, "--out=joined")
        present = lambda: "vehicle-7" in observer.health.present()  # noqa: E731
        assert observer.listen(TIMEOUT_S, present), "vehicle-7 never came"
        observer.health.reset()
        assert observer.listen(TIMEOUT_S, observer.is_right), observer.health.wrong
        joined.process.send_signal(signal.SIGINT)
        assert joined.finish()[0] == 130
        assert observer.listen(TIMEOUT_S, lambda: not present())
        observer.health.reset()
        assert observer.listen(TIMEOUT_S, observer.is_right), observer.health.wrong
    stop(command)


def test_a_process_that_dies_all_the_time_ends_the_run(shell):
    with observed(shell) as (command, _, run_dir):
        for _ in range(MAX_RESTARTS + 1):
            number = processes_of(run_dir)["signal-r0"]
            os.kill(number, signal.SIGKILL)
            wait_until(
                lambda number=number: (
                    processes_of(run_dir)["signal-r0"] != number
                    or command.process.poll() is not None
                )
            )
    status, output = command.finish()
    assert status == 1
    assert "signal was killed by SIGKILL" in output.splitlines()[-1] or "last lines" in output
    assert output.count("started again") == MAX_RESTARTS


def test_the_worlds_death_ends_the_run_all_the_same(shell):
    with observed(shell) as (command, _, run_dir):
        os.kill(processes_of(run_dir)["sim"], signal.SIGKILL)
        status, output = command.finish()
    assert status == 1
    assert "sim was killed by SIGKILL" in output
    assert children_of(run_dir) == {}


def test_a_recorder_that_dies_at_the_end_still_hears_of_it(shell):
    command = shell.up(*REALTIME, "--duration=6", "--out=run")
    run_dir = shell.folder / "run"
    command.read_until("vehicles")
    with_rows = run_dir / "run.sqlite"
    command.wait_until(lambda: newest_frame(with_rows) > 50)
    os.kill(processes_of(run_dir)["record"], signal.SIGKILL)
    status, output = command.finish()
    assert status == 0, output
    assert json.loads(shell.run("report", "run", "--json")[1])["ended"] == "finished"


def newest_frame(database: Path) -> int:
    with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as opened:
        return opened.execute("SELECT max(frame) FROM frames").fetchone()[0] or 0


def test_lockstep_runs_are_not_started_again(shell):
    status, output = shell.up("--restart", "--out=run").finish()
    assert (status, "--restart needs the wall clock" in output) == (2, True), output


def test_so_many_restarts_in_so_much_time():
    restarts, now_ns, pauses_ns = Restarts(), 0, []
    for _ in range(MAX_RESTARTS):
        before_ns = now_ns
        while not restarts.admits("edge", now_ns):
            now_ns += FIRST_PAUSE_NS // 2
        pauses_ns.append(now_ns - before_ns)
    assert pauses_ns == [FIRST_PAUSE_NS * n for n in (0, 1, 2, 4, 8)]
    assert now_ns < WITHIN_NS
    assert restarts.is_exhausted("edge", WITHIN_NS - 1)
    assert not restarts.admits("edge", WITHIN_NS - 1)
    assert restarts.admits("signal", 0)
    assert not restarts.is_exhausted("edge", WITHIN_NS)
    assert restarts.admits("edge", WITHIN_NS)
