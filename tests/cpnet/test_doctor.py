"""Findings of `cpnet doctor`: on this machine, on a bus elsewhere, and when a check fails."""

import io
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta

import pytest
from rich.console import Console

from cpnet import doctor, doctor_buses
from cpnet.doctor import Check, carry_out
from cpnet.endpoints import free_locator
from cpnet.findings import Finding, findings_as_json, print_findings
from protocol.bus import Endpoint, ZenohBus, open_bus
from protocol.clock import time_reply
from protocol.inbox import Inbox
from protocol.topics import BusName
from tests.certificates import make_keys
from tests.cpnet.commands import Shell

Host = Callable[[BusName], tuple[str, ZenohBus]]


@pytest.fixture
def host() -> Iterator[Host]:
    """Hosts a bus on loopback; returns its locator and the bus."""
    made: list[ZenohBus] = []

    def make(name: BusName) -> tuple[str, ZenohBus]:
        locator = free_locator()
        made.append(open_bus(name, Endpoint(locator, listen=True), Inbox()))
        return locator, made[-1]

    yield make
    for bus in made:
        bus.close()


def by_check(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.check: finding for finding in findings}


def test_this_machine_is_examined_and_every_check_has_a_name_of_its_own():
    found = doctor.examine()
    assert len(by_check(found)) == len(found)
    assert by_check(found).keys() >= {"sumo_libraries", "bus_on_loopback", "send_buffer"}
    assert by_check(found)["bus_on_loopback"].ok
    assert by_check(found)["send_buffer"].measured["send_buffer_bytes"] > 1 << 12


def test_sumo_simulates_a_step():
    pytest.importorskip("libsumo", reason="extra sim")
    (found,) = doctor.sumo_runs()
    assert found.ok, found.advice
    assert "simulates a step" in found.what


def test_what_only_some_machines_need_is_said_to_be_absent_and_is_no_fault(monkeypatch):
    monkeypatch.setattr(doctor, "lacking", list)
    monkeypatch.setattr(doctor, "_missing", list)
    found = by_check([*doctor.libraries(), *doctor.sumo_runs()])
    assert all(finding.is_well for finding in found.values())
    written = io.StringIO()
    print_findings(found.values(), Console(file=written, width=500))
    lines = written.getvalue().splitlines()
    (sumo,) = (line for line in lines if "SUMO not" in line)
    assert sumo.split()[0] == "--"
    assert "SUMO not installed (extra sim; only the role sim needs it)" in sumo
    assert "-m pip install" in found["sumo"].advice
    assert found["open3d"].what.startswith("Open3D not installed (extra reference; only edge.")


@pytest.mark.parametrize(
    ("code", "advice"),
    [
        ("import os; os.abort()", "it was killed by SIGABRT it ended without a word"),
        ("raise SystemExit('libX11.so.6: no such file')", "libX11.so.6: no such file"),
        ("import time; time.sleep(60)", "did not simulate one step"),
    ],
)
def test_a_sumo_that_crashes_is_reported(monkeypatch, tmp_path, code, advice):
    pytest.importorskip("libsumo", reason="extra sim")
    (tmp_path / "sim_host").mkdir()
    (tmp_path / "sim_host" / "sumo.py").write_text(code)
    (tmp_path / "sim_host" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor, "TRIAL_TIMEOUT_S", 2)
    (found,) = doctor.sumo_runs()
    assert not found.is_well
    assert advice in found.advice


def test_a_check_that_raises_keeps_what_it_had_found():
    def look() -> Iterator[Finding]:
        yield Finding("first", "first", ok=True)
        raise RuntimeError("no such file")

    first, failed = carry_out(Check("odd", look))
    assert first.ok
    assert (failed.check, failed.ok, failed.optional) == ("odd", False, False)
    assert failed.advice == "failed: RuntimeError: no such file"


def test_a_check_that_hangs_ends_in_time_and_keeps_what_it_had_found():
    release = threading.Event()

    def look() -> Iterator[Finding]:
        yield Finding("first", "first", ok=True)
        release.wait()

    first, late = carry_out(Check("slow", look, limit_s=0.1))
    release.set()
    assert first.ok
    assert late.advice == "did not end within 0.1 s"


def test_only_what_a_run_needs_decides():
    hint, fault = (Finding("a", "a", ok=False, optional=optional) for optional in (True, False))
    assert findings_as_json([hint])["ok"]
    assert not findings_as_json([hint, fault])["ok"]


def test_a_world_tells_its_clock_and_who_is_there(host):
    locator, bus = host(BusName.WORLD)
    bus.answer("time", time_reply())
    bus.announce("sim", "sim")
    found = by_check(list(doctor_buses.examine_bus(BusName.WORLD, Endpoint(locator, listen=False))))
    assert found["world_reached"].ok
    assert found["world_processes"].measured["processes"] == ["sim"]
    clock = found["world_clock"].measured
    assert (clock["offset_ms"], clock["error_ms"]) == (0, 0)
    assert clock["round_trip_ms"] > 0
    assert not found["world_version"].ok  # no process serves a setup here
    assert found["world_version"].is_well


def test_the_clock_of_another_machine_is_known_within_its_error(host):
    locator, bus = host(BusName.WORLD)
    bus.answer("time", time_reply("another machine"))
    bus.announce("sim", "sim")
    found = by_check(
        list(doctor_buses.examine_bus(BusName.WORLD, Endpoint(locator, listen=False)))
    )["world_clock"]
    assert abs(found.measured["offset_ms"]) <= found.measured["error_ms"]  # it is the same clock
    assert "±" in found.what


@pytest.mark.parametrize("name", list(BusName))
def test_a_bus_of_the_other_kind_is_told(host, name):
    other = next(bus for bus in BusName if bus is not name)
    locator, bus = host(other)
    bus.announce("edge", "edge")
    if other is BusName.WORLD:
        bus.answer("time", time_reply())
    found = by_check(list(doctor_buses.examine_bus(name, Endpoint(locator, listen=False))))
    assert not found[f"{name.value}_mistaken"].ok
    assert f"this is the {other.value} bus" in found[f"{name.value}_mistaken"].advice
    assert f"{name.value}_processes" not in found


def test_another_version_of_the_protocol_is_told(host, monkeypatch):
    locator, bus = host(BusName.V2X)
    monkeypatch.setattr("protocol.bus.ALIVE", "cpnet/v9/alive")
    bus.announce("edge", "edge")
    (_, found) = doctor_buses.examine_bus(BusName.V2X, Endpoint(locator, listen=False))
    assert (found.check, found.ok) == ("v2x_protocol", False)
    assert "speak protocol v9" in found.what


@pytest.mark.parametrize("name", list(BusName))
def test_a_bus_without_anybody(host, name):
    locator, _ = host(name)
    (_, found) = doctor_buses.examine_bus(name, Endpoint(locator, listen=False))
    assert (found.ok, found.what) == (False, f"on the {name.value} bus: nobody")


@pytest.mark.parametrize(
    ("locator", "advice"),
    [
        ("tcp/127.0.0.1:1", "nobody listens at this port"),
        ("tcp/nowhere.invalid:7447", "there is no such host"),
        (f"tcp/{'x' * 80}:7447", "there is no such host"),
        ("tcp/256.0.0.1:7447", "there is no such host"),
    ],
)
def test_what_to_do_about_a_bus_that_is_not_reached(locator, advice):
    (found,) = doctor_buses.examine_bus(BusName.WORLD, Endpoint(locator, listen=False))
    assert not found.ok
    assert advice in found.advice


def test_a_server_that_says_nothing_is_no_bus_and_nobody_waits_for_it():
    with closing(socket.create_server(("127.0.0.1", 0))) as silent:
        locator = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        before_ns = time.monotonic_ns()
        findings = doctor.examine_buses({BusName.WORLD: Endpoint(locator, listen=False)})
    assert time.monotonic_ns() - before_ns < 6e9
    assert "does not speak Zenoh" in findings[-1].advice


def test_a_dead_port_is_a_fault_for_programs_too(shell: Shell):
    with socket.socket() as unused:  # bound, but nobody listens
        unused.bind(("127.0.0.1", 0))
        place = f"world=127.0.0.1:{unused.getsockname()[1]}"
        status, output = shell.run("doctor", "--json", "--connect", place)
    found = json.loads(output)
    assert (status, found["ok"]) == (1, False)
    last = found["findings"][-1]
    assert (last["check"], last["ok"], last["optional"]) == ("world_reached", False, False)
    assert "nobody listens at this port: is the role sim running there" in last["advice"]


@pytest.mark.parametrize("implied", [True, False])
def test_a_port_that_nobody_named_is_explained(implied):
    dead = {bus: Endpoint("tcp/127.0.0.1:1", listen=False) for bus in BusName}
    found = by_check(doctor.examine_buses(dead, implied=implied))
    assert ("one port above the V2X bus" in found["world_reached"].advice) is implied
    assert "one port above" not in found["v2x_reached"].advice


def test_certificates_are_looked_through(tmp_path):
    make_keys(tmp_path, now=datetime.now(UTC) - timedelta(days=350))
    (tmp_path / "signal-r0.key").unlink()
    (tmp_path / "record.pem").write_text("no certificate")
    found = {finding.what: finding for finding in doctor.examine_keys(tmp_path)}
    holding = next(finding for what, finding in found.items() if "of router holds until" in what)
    assert (holding.ok, holding.is_well) == (False, True)
    assert "days are left" in holding.advice
    assert "there is no such file" in found["the certificate of signal-r0"].advice
    assert not found["the certificate of record"].is_well


def test_private_keys_that_others_can_read_are_told(tmp_path):
    make_keys(tmp_path)
    (tmp_path / "ca.key").unlink()
    assert all(finding.check == "certificate" for finding in doctor.examine_keys(tmp_path))
    (tmp_path / "sim.key").chmod(0o640)  # for the group of the service
    (tmp_path / "record.key").chmod(0o644)
    (hint,) = (one for one in doctor.examine_keys(tmp_path) if one.check == "private_key")
    assert hint.what == "the private key record.key"
    assert (hint.ok, hint.is_well) == (False, True)
    assert "chmod o-rwx" in hint.advice


def test_the_authoritys_key_beside_a_machines_keys_is_told(tmp_path):
    make_keys(tmp_path)
    hint = by_check(doctor.examine_keys(tmp_path))["authority_key"]
    assert "belongs on the machine that makes keys only" in hint.advice
    assert hint.is_well


def test_buses_with_keys_are_asked_with_the_keys_of_whoever_looks_on(shell: Shell):
    make_keys(shell.folder / "keys")
    with socket.socket() as first, socket.socket() as second:
        for probe in (first, second):
            probe.bind(("127.0.0.1", 0))
        ports = [probe.getsockname()[1] for probe in (first, second)]
    places = [f"v2x=127.0.0.1:{ports[0]}", f"world=127.0.0.1:{ports[1]}"]
    run = shell.up(
        "--keys=keys",
        "--mode=realtime",
        "--duration=600",
        *(f"--listen={place}" for place in places),
    )
    run.read_until("vehicles")
    asked = ["doctor", "--json", *(f"--connect={place}" for place in places)]
    found = json.loads(shell.run(*asked, "--keys=keys")[1])["findings"]
    known = {finding["check"]: finding for finding in found}
    for check in ("v2x_processes", "world_processes", "world_clock", "world_version"):
        assert known[check]["ok"], known[check]
    assert "infra-r0" in known["v2x_processes"]["measured"]["processes"]
    plain = {one["check"]: one for one in json.loads(shell.run(*asked)[1])["findings"]}
    assert "give --keys DIR" in plain["world_zenoh"]["advice"]
