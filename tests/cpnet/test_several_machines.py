"""Roles on hosts of their own: network namespaces on switches, uplinks shaped by `tc tbf`."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from protocol.errors import ConfigError
from protocol.traffic import on_air_bytes
from recording.run import Run, differences
from tests.cpnet.city import City, Host
from tests.cpnet.commands import SMALL, Command, Shell
from tests.soak.findings import processes_of

pytestmark = pytest.mark.root

UPLINK_MBPS = 5
STEADY_FRAMES = 5
PLACES = {
    "world": "sim,record",
    "edge": "router,edge",
    "signal": "signal",
    "post": "infra",
    "car-0": "vehicle-0",
    "car-1": "vehicle-1",
}
WITHOUT_END = ("--mode=realtime", "--duration=600", "--set=edge.deadline_ms=300")
FOREIGN_ROUTER = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_file(sys.argv[1]))
print("ready", flush=True)
sys.stdin.read()
"""


class Machines:
    """Six hosts with a role each, and one more for a plain Zenoh router; keys for all."""

    def __init__(self, shell: Shell, city: City) -> None:
        self.folder = shell.folder
        self.hosts: dict[str, Host] = {}
        for place in (*PLACES, "router"):
            shaped = place.startswith("car")
            self.hosts[place] = city.host(place, f"{UPLINK_MBPS}mbit" if shaped else "")
        self._shell = shell
        self._v2x = "edge"
        self._commands: dict[str, Command] = {}
        addresses = [self.hosts[p].v2x for p in ("edge", "router")] + [self.hosts["world"].world]
        hosts = [f"--host={address}" for address in addresses]
        status, output = shell.run("keys", "keys", *hosts, "--router-config=router.json5")
        assert status == 0, output

    def up(self, *scenario: str, everywhere: tuple[str, ...] = ()) -> None:
        """Starts all roles, each on its host."""
        for place in PLACES:
            more = ("t_junction", *SMALL, *scenario) if place == "world" else ()
            self.up_on(place, *more, *everywhere)

    def up_on(self, place: str, *more: str, out: str = "") -> None:
        """Starts the roles of one host."""
        buses = {"v2x": (self._v2x, 7447), "world": ("world", 7448)}
        words = ["up", *more, f"--only={PLACES[place]}", "--keys=keys", f"--out={out or place}"]
        for bus, (host, port) in buses.items():
            address = getattr(self.hosts[host], bus)
            words.append(f"--{'listen' if host == place else 'connect'}={bus}={address}:{port}")
        self._commands[place] = self._shell.start(*words, within=self.hosts[place].namespace)

    def start_router(self) -> subprocess.Popen[bytes]:
        """Starts a Zenoh router that knows nothing of cpnet, and moves the V2X bus there."""
        self._v2x = "router"
        enter = ["ip", "netns", "exec", self.hosts["router"].namespace]
        command = [*enter, sys.executable, "-c", FOREIGN_ROUTER, "router.json5"]
        router = subprocess.Popen(
            command, cwd=self.folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert router.stdout is not None
        assert router.stdout.readline() == b"ready\n"
        return router

    def lose(self, place: str) -> None:
        """Kills all that runs on a host."""
        command = self._commands.pop(place)
        command.process.kill()
        command.finish()

    def finish(self) -> None:
        """Waits until all have come to their end well."""
        for place, command in self._commands.items():
            status, output = command.finish()
            assert status == 0, f"{place}: {output}"

    def stop(self) -> None:
        """Ends the world, and with it all others."""
        self._commands["world"].process.send_signal(signal.SIGINT)
        for place, command in self._commands.items():
            status, output = command.finish()
            is_reported = "the world ended before its time: stopped" in output
            assert (status, is_reported) == ((130, False) if place == "world" else (1, True)), (
                output
            )

    def run_dir(self, place: str) -> Path:
        return self.folder / place

    def await_right(self) -> None:
        """Waits for frames from now on that have all agents and led to a request."""
        since_ns = time.monotonic_ns()
        self._wait_until(lambda: self._right_frames(since_ns) >= STEADY_FRAMES)

    def await_measured(self, process: str) -> None:
        """Waits for frames from now on in which a process plays agents."""
        sql = "SELECT count(*) FROM stages WHERE start_ns > ? AND process = ?"
        since_ns = time.monotonic_ns()
        self._wait_until(lambda: self._count(sql, since_ns, process) >= STEADY_FRAMES)

    def _wait_until(self, holds: Callable[[], bool]) -> None:
        self._commands["world"].wait_until(holds)

    def _right_frames(self, since_ns: int) -> int:
        sql = (
            "SELECT count(*) FROM frames WHERE tick_ns > ? AND complete = 1 "
            "AND agents > cavs AND request_ns NOT NULL"  # the post, and all CAVs
        )
        return self._count(sql, since_ns)

    def _count(self, sql: str, *values: int | str) -> int:
        try:
            with Run(self.run_dir("world")) as run:
                return int(run.query(sql, *values)[0][0])
        except ConfigError:  # the recorder has not begun
            return 0


@pytest.fixture
def machines(shell: Shell) -> Iterator[Machines]:
    with City() as city:
        yield Machines(shell, city)
        shell.stop_all()


def test_roles_on_six_hosts_give_the_same_rows_as_on_one(machines: Machines, first_run: Path):
    machines.up("--duration=8")
    machines.finish()
    assert differences(first_run, machines.run_dir("world")) == []


def test_behind_a_router_that_is_not_ours_the_rows_are_the_same(
    machines: Machines, first_run: Path
):
    with machines.start_router() as router:
        machines.up("--duration=8")
        machines.finish()
        router.kill()
    assert differences(first_run, machines.run_dir("world")) == []


def test_scans_take_as_long_as_the_shaped_uplinks_say(machines: Machines):
    larger = ("--set=lidar.vehicle.points_per_second=720000", "--set=edge.deadline_ms=400")
    machines.up("--mode=realtime", "--duration=6", *larger)
    machines.finish()
    sql = (
        "SELECT payload_bytes, received_ns - encode_end_ns FROM uploads "
        "WHERE received_ns NOT NULL AND agent <> 'rsu-0'"
    )
    with Run(machines.run_dir("world")) as run:
        uploads = run.query(sql)
        errors_ns = {error_ns for (error_ns,) in run.query("SELECT error_ns FROM clocks")}
    assert len(uploads) > 20
    least = min(took_ns / (on_air_bytes(size) * 8e3 / UPLINK_MBPS) for size, took_ns in uploads)
    assert least == pytest.approx(1, abs=0.15)
    assert errors_ns == {0}  # hosts of one kernel have one clock


def test_hosts_and_roles_come_and_go_while_the_world_goes_on(machines: Machines):
    machines.up(*WITHOUT_END, everywhere=("--restart",))
    machines.await_right()
    for place, process in (
        ("edge", "edge-r0"),
        ("edge", "router"),
        ("signal", "signal-r0"),
        ("world", "record"),
    ):
        os.kill(processes_of(machines.run_dir(place))[process], signal.SIGKILL)
        machines.await_right()
    machines.lose("car-0")  # its CAVs go to the other host
    machines.await_right()
    machines.up_on("car-0", "--restart", out="car-0-again")
    machines.await_measured("vehicle-0")
    machines.await_right()
    machines.stop()
    with Run(machines.run_dir("world")) as run:
        gaps = run.query("SELECT away, count(*) FROM gaps GROUP BY away")
        assert gaps == [("recorder", 1), ("v2x", 1)]  # its router died
        assert run.meta["end_reason"] == "stopped"


def test_a_router_that_is_not_ours_may_die_and_come_back(machines: Machines):
    with machines.start_router() as router:
        machines.up(*WITHOUT_END)
        machines.await_right()
        router.kill()
    with machines.start_router() as router:
        machines.await_right()
        machines.stop()
        router.kill()


def test_four_regions_on_four_hosts_give_the_same_rows_as_on_one(shell: Shell):
    scenario = ("corridor", *SMALL, "--regions=4", "--cav-rate=0.2", "--duration=4")
    status, output = shell.run("up", *scenario, "--out=here")
    assert status == 0, output
    with City() as city:
        hosts = [city.host(f"r{n}") for n in range(4)]
        buses = f"v2x={hosts[0].v2x}:7447", f"world={hosts[0].world}:7448"
        roles = [f"edge-r{n},signal-r{n},infra-r{n}" for n in range(4)]
        roles[0] += ",router,sim,record"
        roles[2] += ",vehicle-0"
        roles[3] += ",vehicle-1"
        commands = []
        for n, host in enumerate(hosts):
            places = [f"--{'connect' if n else 'listen'}={bus}" for bus in buses]
            words = ["up", *(() if n else scenario), f"--only={roles[n]}", *places, "--insecure"]
            commands.append(shell.start(*words, f"--out=host-{n}", within=host.namespace))
        for command in commands:
            status, output = command.finish()
            assert status == 0, output
        shell.stop_all()
    assert differences(shell.folder / "here", shell.folder / "host-0") == []
