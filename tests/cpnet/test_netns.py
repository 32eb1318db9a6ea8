"""`cpnet up --netns`: real runs with a namespace per agent, and how it is refused."""

import os
import signal
import sqlite3
from pathlib import Path

import pytest

from cpnet.doctor import checks
from link_relay.netns import probe
from link_relay.netns.leftovers import lives
from sensing.link.path import on_air_bytes
from tests.cpnet.conftest import Command, Shell, children_of
from tests.link_relay.netns.made import made_by
from tests.waiting import wait_until

REALTIME = ("--netns", "--mode=realtime", "--cav-rate=0.1", "--out=run")
LARGE = ("--set=lidar.vehicle.points_per_second=720000", "--set=edge.deadline_ms=300")


def relay_of(command: Command, folder: Path) -> int:
    """Returns the relay's process id when agents are connected through its namespaces."""
    command.read_until("vehicles")
    relay = children_of(folder / "run")["relay-vehicle"]
    ended = lambda: command.process.poll() is not None  # noqa: E731
    wait_until(lambda: made_by(relay) or ended(), 60, what="no CAV ever came")
    assert not ended(), command.finish()
    return relay


@pytest.mark.root
def test_uploads_take_as_long_as_the_rate_says_and_nothing_stays(shell):
    command = shell.up(*REALTIME, *LARGE, "--link=5mbit", "--duration=8")
    relay = relay_of(command, shell.folder)
    status, output = command.finish()
    assert status == 0, output
    assert made_by(relay) == []
    with sqlite3.connect(f"file:{shell.folder}/run/run.sqlite?mode=ro", uri=True) as database:
        sql = (
            "SELECT payload_bytes, received_ns - encode_end_ns FROM uploads "
            "WHERE received_ns NOT NULL AND agent {} 'rsu-0'"
        )
        vehicles = database.execute(sql.format("<>")).fetchall()
        roadside = database.execute(sql.format("=")).fetchall()
    over_rate = [took_ns / (on_air_bytes(size) * 8 * 200) for size, took_ns in vehicles]
    assert len(over_rate) > 40
    assert min(over_rate) == pytest.approx(1, abs=0.15)  # of the scan that nothing held up
    assert min(took_ns / (size * 8 * 200) for size, took_ns in roadside) < 0.7  # it is wired


@pytest.mark.root
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_leaves_nothing(shell, number):
    command = shell.up(*REALTIME, "--link=lte", "--duration=600")
    relay = relay_of(command, shell.folder)
    command.process.send_signal(number)
    status, output = command.finish()
    assert status == 128 + number, output
    assert "no netem" not in output or "round trip of lte is not applied" in output
    assert made_by(relay) == []


@pytest.mark.root
def test_a_killed_relay_leaves_nothing(shell):
    command = shell.up(*REALTIME, "--link=5mbit", "--duration=600")
    relay = relay_of(command, shell.folder)
    os.kill(relay, signal.SIGKILL)
    status, output = command.finish()
    assert status == 1
    assert "relay-vehicle was killed by SIGKILL" in output
    assert made_by(relay) == []


@pytest.mark.root
def test_a_killed_supervisor_leaves_nothing(shell):
    command = shell.up(*REALTIME, "--link=5mbit", "--duration=600")
    relay = relay_of(command, shell.folder)
    command.process.kill()
    command.finish()
    wait_until(lambda: not lives(relay))
    assert made_by(relay) == []


@pytest.mark.root
def test_what_a_run_killed_as_a_whole_left_is_removed_at_the_next_start(shell):
    command = shell.up(*REALTIME, "--link=5mbit", "--duration=600")
    relay = relay_of(command, shell.folder)
    command.process.send_signal(signal.SIGSTOP)  # so that it does not tidy up
    os.kill(relay, signal.SIGKILL)
    command.process.kill()
    command.finish()
    wait_until(lambda: not lives(relay))
    again = ("--netns", "--mode=realtime", "--link=5mbit", "--out=again", "--duration=1")
    status, output = shell.up(*again).finish()
    assert status == 0, output
    assert made_by(relay) == []


@pytest.mark.parametrize(
    ("given", "missing"),
    [
        (("--mode=realtime",), "give --link, such as --link 5mbit"),
        (("--link=5mbit",), "give --mode realtime"),
    ],
)
def test_netns_without_what_it_needs_is_refused(shell, given, missing):
    status, output = shell.run("up", "--netns", *given)
    assert (status, missing in output, "Traceback" in output) == (2, True, False), output


def test_a_machine_without_iproute2_is_told_of_the_relay(shell: Shell, monkeypatch):
    monkeypatch.setenv("PATH", str(shell.folder))
    options = ("--netns", "--mode=realtime", "--link=5mbit", "--out=run")
    status, output = shell.run("up", *options)
    assert status == 2, output
    assert "Debian package iproute2" in output
    assert "a relay shapes the links, which needs no root" in output
    assert not (shell.folder / "run").exists()


def test_doctor_names_what_is_missing_and_does_not_mind(monkeypatch):
    monkeypatch.setattr(probe, "examine", lambda: probe.Ability("tbf", delays=False))
    found = next(finding for finding in checks.examine() if "--netns" in finding.what)
    assert (found.ok, found.optional, found.advice) == (False, True, "tbf")
