import errno
import json
import os
import shutil
import signal
from dataclasses import replace
from multiprocessing import forkserver
from pathlib import Path

import pytest

from cpnet.endpoints import resolve
from cpnet.exit_report import log_tail
from cpnet.processes import (
    ROLES,
    ProcessEntry,
    RoleEntry,
    parse_only,
    processes_of,
    processes_without_scenario,
)
from cpnet.scenario import Scenario
from cpnet.supervisor import LIST_NAME, MAX_RESTARTS, Supervisor
from protocol.errors import ConfigError
from protocol.topics import BusName
from tests.waiting import wait_until

pytestmark = pytest.mark.process

SLEEPER = """
import signal, sys, time
def main():
    {ignore}
    print("ready", file=sys.stderr, flush=True)
    time.sleep(60)
main()
"""


@pytest.fixture
def supervisor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Supervisor:
    monkeypatch.syspath_prepend(tmp_path)
    return Supervisor(tmp_path, resolve([], [], set(BusName)))


def entry(tmp_path: Path, name: str, code: str) -> ProcessEntry:
    (tmp_path / f"{name}.py").write_text(code)
    return ProcessEntry(name, RoleEntry(name, name))


def wait_for(path: Path, text: str) -> None:
    """Waits for a line of a child's log."""
    wait_until(
        lambda: path.exists() and text in path.read_text(), what=f"{path} never held {text!r}"
    )


def test_a_process_that_ends_is_named_with_its_log(supervisor, tmp_path):
    code = "import sys; sys.exit('the cat ate the lidar')"
    with supervisor:
        supervisor.start([entry(tmp_path, "short_lived", code)])
        wait_for(tmp_path / "logs" / "short_lived.log", "lidar")
        failure = wait_until(lambda: supervisor.failure(at_end=False))
    assert (failure.id, failure.how) == ("short_lived", "ended with status 1")
    assert failure.tail == "the cat ate the lidar"


def test_a_killed_process_is_named_before_those_that_fell_with_it(supervisor, tmp_path):
    with supervisor:
        supervisor.start(
            [
                entry(tmp_path, "fell", "raise SystemExit(1)"),
                entry(tmp_path, "killed", "import os; os.kill(os.getpid(), 9)"),
            ]
        )
        wait_until(lambda: not supervisor.running("fell", "killed"))
        failure = supervisor.failure(at_end=False)
    assert (failure.id, failure.how) == ("killed", "was killed by SIGKILL")


def test_whoever_died_is_started_again_and_dying_all_the_time_is_no_life(
    supervisor, tmp_path, monkeypatch
):
    monkeypatch.setattr("cpnet.supervisor.FIRST_PAUSE_NS", 0)
    with supervisor:
        supervisor.start([entry(tmp_path, "frail", "raise SystemExit(3)")])
        for _ in range(MAX_RESTARTS):
            wait_until(lambda: not supervisor.running("frail"))
            found, lost = supervisor.restart_ended()
            assert ([failure.how for failure in found], lost) == (
                ["ended with status 3; started again"],
                [],
            )
        wait_until(lambda: not supervisor.running("frail"))
        found, lost = supervisor.restart_ended()
        assert (found, [failure.id for failure in lost]) == ([], ["frail"])


def test_at_the_runs_end_a_process_that_ends_well_is_no_death(supervisor, tmp_path):
    with supervisor:
        supervisor.start([entry(tmp_path, "done", "pass")])
        wait_until(lambda: not supervisor.running("done"))
        assert supervisor.failure(at_end=True) is None
        assert supervisor.failure(at_end=False) is not None


def test_a_process_that_will_not_stop_is_killed(supervisor, tmp_path, monkeypatch):
    monkeypatch.setattr("cpnet.supervisor.GRACE_S", 0.2)
    ignore = "signal.signal(signal.SIGINT, signal.SIG_IGN)"
    supervisor.start([entry(tmp_path, "stubborn", SLEEPER.format(ignore=ignore))])
    wait_for(tmp_path / "logs" / "stubborn.log", "ready")
    assert supervisor.stop() == ["stubborn"]


def test_a_process_that_stops_when_asked_is_not_killed(supervisor, tmp_path):
    heed = "signal.signal(signal.SIGINT, signal.default_int_handler)"  # it may be ignored around us
    supervisor.start([entry(tmp_path, "polite", SLEEPER.format(ignore=heed))])
    wait_for(tmp_path / "logs" / "polite.log", "ready")
    assert supervisor.stop() == []


LOCKED = """
import fcntl, signal, sys, time
def main():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    file = open({path!r}, "a")
    print("ready", file=sys.stderr, flush=True)
    fcntl.flock(file, fcntl.LOCK_EX)
    print("mine", file=sys.stderr, flush=True)
    time.sleep({hold_s})
main()
"""


def test_a_recorder_may_write_on_when_others_that_would_not_stop_are_killed(
    supervisor, tmp_path, monkeypatch
):
    """It ends once the other is gone, which holds a lock."""
    monkeypatch.setattr("cpnet.supervisor.GRACE_S", 0.2)
    monkeypatch.setattr("cpnet.supervisor.LAST_GRACE_S", 30.0)
    path = str(tmp_path / "lock")
    supervisor.start([entry(tmp_path, "stubborn", LOCKED.format(path=path, hold_s=60))])
    wait_for(tmp_path / "logs" / "stubborn.log", "mine")
    recorder = entry(tmp_path, "recorder", LOCKED.format(path=path, hold_s=0))
    supervisor.start([replace(recorder, role=RoleEntry("mcap", "recorder"))])
    wait_for(tmp_path / "logs" / "recorder.log", "ready")
    assert supervisor.stop() == ["stubborn"]
    assert "mine" in (tmp_path / "logs" / "recorder.log").read_text()


def kill_fork_server() -> None:
    os.kill(forkserver._forkserver._forkserver_pid, signal.SIGKILL)


def test_who_outlives_the_fork_server_stays_and_is_stopped(supervisor, tmp_path):
    heed = "signal.signal(signal.SIGINT, signal.default_int_handler)"
    supervisor.start([entry(tmp_path, "orphan", SLEEPER.format(ignore=heed))])
    wait_for(tmp_path / "logs" / "orphan.log", "ready")
    assert supervisor.fork_server_exit() is None
    kill_fork_server()
    failure = wait_until(supervisor.fork_server_exit)
    assert (failure.id, supervisor.fork_server_exit()) == ("fork-server", None)
    assert (supervisor.running("orphan"), supervisor.failure(at_end=False)) == (True, None)
    assert supervisor.restart_ended() == ([], [])
    number = json.loads((tmp_path / LIST_NAME).read_text())["orphan"]
    assert supervisor.stop() == []
    wait_until(lambda: not Path(f"/proc/{number}").exists())


def test_without_its_fork_server_a_death_is_seen_and_another_server_starts(supervisor, tmp_path):
    heed = "signal.signal(signal.SIGINT, signal.default_int_handler)"
    names = ["one", "other"]
    with supervisor:
        supervisor.start([entry(tmp_path, n, SLEEPER.format(ignore=heed)) for n in names])
        for name in names:
            wait_for(tmp_path / "logs" / f"{name}.log", "ready")
        kill_fork_server()
        wait_until(supervisor.fork_server_exit)
        before = json.loads((tmp_path / LIST_NAME).read_text())
        os.kill(before["one"], signal.SIGKILL)
        wait_until(lambda: not supervisor.running("one"))
        assert supervisor.failure(at_end=True) is None
        assert "had gone" in supervisor.failure(at_end=False).how
        found, lost = supervisor.restart_ended()
        after = json.loads((tmp_path / LIST_NAME).read_text())
        assert ([failure.id for failure in found], lost) == (["one"], [])
        assert after["other"] == before["other"]
        assert supervisor.running("one")


def test_who_cannot_be_started_again_is_tried_again(supervisor, tmp_path, monkeypatch):
    def no_pipe(**_: bool) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr("cpnet.supervisor.FIRST_PAUSE_NS", 0)
    with supervisor:
        supervisor.start([entry(tmp_path, "unlucky", "raise SystemExit(3)")])
        wait_until(lambda: not supervisor.running("unlucky"))
        with monkeypatch.context() as without_files:
            without_files.setattr("multiprocessing.Pipe", no_pipe)
            for _ in range(MAX_RESTARTS - 1):
                found, lost = supervisor.restart_ended()
                assert ("Too many open files" in found[0].how, lost) == (True, [])
        found, lost = supervisor.restart_ended()
        assert ([failure.how for failure in found], lost) == (
            ["ended with status 3; started again"],
            [],
        )
        wait_until(lambda: not supervisor.running("unlucky"))
        assert [failure.id for failure in supervisor.restart_ended()[1]] == ["unlucky"]


def test_who_is_stopped_and_does_not_go_on_is_started_again(supervisor, tmp_path, monkeypatch):
    monkeypatch.setattr("cpnet.supervisor.STOPPED_NS", 50_000_000)
    with supervisor:
        supervisor.start([entry(tmp_path, "stuck", SLEEPER.format(ignore=""))])
        wait_for(tmp_path / "logs" / "stuck.log", "ready")
        assert (supervisor.restart_ended(), supervisor.stopped(1)) == (([], []), [])
        number = json.loads((tmp_path / LIST_NAME).read_text())["stuck"]
        os.kill(number, signal.SIGSTOP)
        wait_until(lambda: supervisor.stopped(1))
        found, _ = wait_until(lambda: any(restarted := supervisor.restart_ended()) and restarted)
        assert found[0].how == "was stopped (SIGSTOP) for 0 s; started again"
        assert json.loads((tmp_path / LIST_NAME).read_text())["stuck"] != number


def refuse_to_write(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)


def test_a_full_disk_ends_no_run_for_want_of_its_list(supervisor, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("cpnet.supervisor.FIRST_PAUSE_NS", 0)
    frail = entry(tmp_path, "frail", "raise SystemExit(3)")
    with supervisor:
        supervisor.start([frail])
        assert (tmp_path / LIST_NAME).exists()
        refuse_to_write(monkeypatch)
        for _ in range(2):
            wait_until(lambda: not supervisor.running("frail"))
            assert [failure.id for failure in supervisor.restart_ended()[0]] == ["frail"]
    assert not list(tmp_path.glob("processes.*"))
    assert caplog.text.count("No space left on device") == 1


def test_an_empty_log_on_a_full_disk_says_why_it_is_empty(tmp_path, monkeypatch):
    log = tmp_path / "record.log"
    log.touch()
    assert log_tail(log) == "(its log is empty)"
    usage = shutil.disk_usage(tmp_path)._replace(free=4096)
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage)
    assert log_tail(log) == f"(its log is empty: the disk that holds {tmp_path} is full)"


def test_a_folder_that_cannot_be_written_is_a_plain_mistake(tmp_path):
    (tmp_path / "logs").write_text("no folder")
    with pytest.raises(ConfigError, match="cannot be written: .*File exists"):
        Supervisor(tmp_path, resolve([], [], set(BusName))).start([])


def test_hosts_of_the_buses_start_first():
    assert [row.role for row in ROLES if row.hosts] == [row.role for row in ROLES[:2]]


def test_the_scenario_says_how_many_processes_there_are():
    scenario = Scenario.model_validate(
        {
            "processes": {"vehicle": 3},
            "regions": {"r0": ["J"], "r1": ["K"]},
            "roadside_mounts": [{"id": "a", "tls": "J"}, {"id": "b", "tls": "K"}],
        }
    )
    ids = [p.id for p in processes_of(parse_only("vehicle,infra"), scenario)]
    assert ids == ["infra-r0", "infra-r1", "vehicle-0", "vehicle-1", "vehicle-2"]


def test_an_unknown_role_is_refused_with_the_allowed_ones():
    with pytest.raises(ConfigError, match="no role 'edgy'; allowed: router, sim, record"):
        parse_only("edge,edgy")


def test_every_role_is_a_package_with_a_main_module():
    root = Path(__file__).parents[2]
    for row in ROLES:
        assert (root / row.module.replace(".", "/") / "__main__.py").is_file(), row.module


def test_what_was_named_runs_whatever_the_scenario_is():
    found = [
        process.id
        for process in processes_without_scenario(
            parse_only("router,mcap,infra,edge-r3,vehicle-7,vehicle-1")
        )
    ]
    assert found == ["router", "edge-r3", "vehicle-1", "vehicle-7"]
