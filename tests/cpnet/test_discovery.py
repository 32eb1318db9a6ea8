"""How observers find a run."""

import io
import json
import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest
from rich.console import Console

from cpnet import discovery
from cpnet.discovery import connected_to_world, discoverable, find_run
from cpnet.endpoints import free_locator
from protocol.access import Keys
from protocol.bus import Endpoint, ZenohBus, open_bus
from protocol.errors import BusError, ConfigError
from protocol.inbox import Inbox
from protocol.messages import Setup
from protocol.topics import BusName
from tests.certificates import make_keys
from tests.cpnet.commands import Shell, free_ports
from tests.messages import EXAMPLES
from tests.waiting import TIMEOUT_S, wait_until

BUSES = {
    BusName.V2X: Endpoint("tcp/0.0.0.0:7447", listen=True),
    BusName.WORLD: Endpoint("tcp/127.0.0.1:7448", listen=True),
}


def test_a_run_can_be_found_as_long_as_it_goes_on(tmp_path):
    with discoverable(tmp_path, BUSES, None):
        found = find_run(tmp_path, [], None)
        assert (found.v2x.locator, found.world.locator) == (
            "tcp/127.0.0.1:7447",
            "tcp/127.0.0.1:7448",
        )
        assert not found.v2x.listen
    with pytest.raises(ConfigError, match="no run goes on there"):
        find_run(tmp_path, [], None)


def test_a_folder_that_cannot_take_the_note_is_a_plain_mistake(tmp_path):
    gone = tmp_path / "gone"
    with pytest.raises(ConfigError, match="cannot be written"), discoverable(gone, BUSES, None):
        pass


def test_without_a_folder_it_is_the_newest_that_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(discovery, "RUNS", tmp_path)
    with pytest.raises(ConfigError, match="no run goes on in"):
        find_run(None, [], None)
    for n, pid in enumerate((os.getpid(), os.getpid(), 2**22 + 1, 0, -5)):
        folder = tmp_path / str(n)
        folder.mkdir()
        path = folder / "buses.json"
        path.write_text(json.dumps({"v2x": "tcp/h:1", "world": "tcp/h:2", "pid": pid}))
        os.utime(path, (n, n))
    assert find_run(None, [], None).run_dir == tmp_path / "1"


def test_a_run_elsewhere_has_two_buses():
    found = find_run(None, ["host:7447"], None)
    assert (found.v2x.locator, found.world.locator) == ("tcp/host:7447", "tcp/host:7448")
    with pytest.raises(ConfigError, match="where is the world bus"):
        find_run(None, ["v2x=host:7447"], None)


def test_a_run_that_ends_while_it_is_looked_for_is_none(tmp_path, monkeypatch):
    monkeypatch.setattr(discovery, "RUNS", tmp_path)
    (tmp_path / "gone").mkdir()
    (tmp_path / "gone" / "buses.json").symlink_to(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="no run goes on in"):
        find_run(None, [], None)


def test_a_name_that_no_folder_can_have_is_no_run(tmp_path):
    with pytest.raises(ConfigError, match="no run goes on there"):
        find_run(tmp_path / ("x" * 300), [], None)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"pid": "x"}'])
def test_a_damaged_note_is_no_run(tmp_path, text):
    (tmp_path / "buses.json").write_text(text)
    with pytest.raises(ConfigError, match="no run goes on there"):
        find_run(tmp_path, [], None)


def test_a_folder_and_a_place_are_one_too_many(tmp_path):
    with pytest.raises(ConfigError, match="not both"):
        find_run(tmp_path, ["host:7447"], None)


@pytest.mark.parametrize(
    ("made", "error_text"),
    [
        (None, "would start one"),
        ("run.sqlite", "it has ended: `cpnet report"),
        ("else", "it is no run folder"),
    ],
)
def test_what_can_be_done_instead_is_said(tmp_path, made, error_text):
    if made is not None:
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / made).touch()
    with pytest.raises(ConfigError, match=error_text):
        find_run(tmp_path / "run", [], None)


WAIT_S = TIMEOUT_S
ENDS_WITHIN_S = 10.0


@pytest.fixture
def console() -> Console:
    return Console(file=io.StringIO(), width=200)


@pytest.fixture
def place() -> Endpoint:
    return Endpoint(free_locator(), listen=False)


@pytest.fixture
def host(place: Endpoint) -> Iterator[ZenohBus]:
    bus = open_bus(BusName.WORLD, Endpoint(place.locator, listen=True), Inbox())
    yield bus
    bus.close()


def printed(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_who_waits_says_for_what_and_ends_when_told(shell: Shell, number):
    start = shell.start("up", "--only=vehicle", "--connect=127.0.0.1:1", "--out=run")
    start.read_until("waiting for the world bus at 127.0.0.1:2 (Ctrl-C ends)")
    told_s = time.monotonic()
    os.kill(start.process.pid, number)
    status, output = start.finish(WAIT_S)
    assert time.monotonic() - told_s < ENDS_WITHIN_S
    assert status == 128 + number
    assert "Traceback" not in output
    assert list(shell.folder.iterdir()) == []


def test_a_world_that_does_not_come_is_named_with_all_the_time_it_had(place, console, monkeypatch):
    monkeypatch.setattr(discovery, "JOIN_TIMEOUT_S", 1.5)
    with (
        pytest.raises(BusError, match=rf"answers at {place.locator} for .* \(waited 1.5 s\)"),
        connected_to_world(place, console, wait_forever=False),
    ):
        pass
    assert printed(console).count("waiting for the world bus") == 1


def test_keys_of_another_authority_are_named(tmp_path, console, monkeypatch):
    monkeypatch.setattr(discovery, "JOIN_TIMEOUT_S", 0.1)
    own, other = (make_keys(tmp_path / name) for name in ("own", "other"))
    locator = free_locator("tls")
    host = Endpoint(locator, listen=True, keys=Keys.of(own, "sim"))
    bus = open_bus(BusName.WORLD, host, Inbox())
    stranger = Endpoint(locator, listen=False, keys=Keys.of(other, "watch"))
    with (
        pytest.raises(BusError, match="certificate of the same authority that names 127.0.0.1"),
        connected_to_world(stranger, console, wait_forever=False),
    ):
        pass
    bus.close()


def test_a_world_that_serves_nothing_is_named(place, host, console, monkeypatch):
    monkeypatch.setattr(discovery, "JOIN_TIMEOUT_S", 0.1)
    with (
        connected_to_world(place, console, wait_forever=False) as world,
        pytest.raises(BusError, match="nobody there serves setup"),
    ):
        world.setup()


def test_who_lasts_waits_beyond_the_time_and_says_why_once(console):
    waiting = discovery.WaitingTime("the world bus", console, endless=True)
    waiting._began_s -= discovery.JOIN_TIMEOUT_S
    for _ in range(2):
        waiting.wait(BusError("nothing answers"))
    assert printed(console).splitlines() == [
        "waiting for the world bus (Ctrl-C ends); `cpnet doctor --connect` tells what is wrong",
        "still waiting: nothing answers",
    ]


def test_the_setup_is_what_the_host_serves(place, host, console):
    (setup,) = (message for message in EXAMPLES if isinstance(message, Setup))
    host.serve("setup", setup)
    with connected_to_world(place, console, wait_forever=False) as world:
        assert world.setup().scenario == setup.scenario
    assert printed(console) == ""


def test_a_world_of_another_version_is_named_at_once(place, host, console, monkeypatch):
    monkeypatch.setattr("protocol.bus.ALIVE", "cpnet/v0/alive")
    host.announce("sim", "sim")
    with (
        connected_to_world(place, console, wait_forever=True) as world,
        pytest.raises(BusError, match="they speak version 0 of the protocol, this side 4: install"),
    ):
        world.setup()


def test_strangers_on_the_same_bus_keep_nobody_from_waiting(place, host, console, monkeypatch):
    monkeypatch.setattr(discovery, "JOIN_TIMEOUT_S", 0.1)
    host.announce("sim", "sim")
    monkeypatch.setattr("protocol.bus.ALIVE", "cpnet/v0/alive")
    host.announce("signal", "signal")
    with (
        connected_to_world(place, console, wait_forever=False) as world,
        pytest.raises(BusError, match="nobody there serves setup"),
    ):
        world.setup()


def test_who_is_there_already_is_not_started_twice(place, host, console):
    host.announce("signal", "signal")
    host.announce("vehicle", "vehicle-0")
    with connected_to_world(place, console, wait_forever=False) as world:
        world.refuse_duplicates(["edge", "vehicle-1"])
        with pytest.raises(ConfigError, match="^vehicle-0 runs on this bus already: stop it, or"):
            world.refuse_duplicates(["vehicle-0", "vehicle-1"])


def test_who_lasts_waits_until_what_is_left_of_a_lost_machine_has_gone(place, host, console):
    lost = open_bus(BusName.WORLD, place, Inbox())
    lost.announce("vehicle", "vehicle-0")
    with connected_to_world(place, console, wait_forever=True) as world:
        wait_until(lambda: world._roll().present == ["vehicle-0"])
        going = threading.Timer(1.5, lost.close)
        going.start()
        world.refuse_duplicates(["vehicle-0"])
        going.join()
    assert printed(console).splitlines() == ["waiting for another vehicle-0 to be gone"]


def test_who_lasts_gives_up_on_one_that_stays(place, host, console, monkeypatch):
    monkeypatch.setattr(discovery, "LOST_S", 0.2)
    host.announce("vehicle", "vehicle-0")
    with (
        connected_to_world(place, console, wait_forever=True) as world,
        pytest.raises(ConfigError, match="runs on this bus already"),
    ):
        world.refuse_duplicates(["vehicle-0"])


def test_a_second_signal_beside_a_whole_run_is_refused(shell: Shell):
    ports = free_ports()
    run = shell.up("--duration=600", "--mode=realtime", f"--listen=127.0.0.1:{ports}", "--out=run")
    run.read_until("vehicles")
    again = shell.start("up", "--only=signal", f"--connect=127.0.0.1:{ports}", "--out=again")
    status, output = again.finish(WAIT_S)
    assert status == 2, output
    assert "signal-r0 runs on this bus already: stop it, or take another with --only" in output
    assert not (shell.folder / "again").exists()
    assert run.process.poll() is None
