"""Rogue clients on the buses of a real run with keys: they cannot publish, receive or impersonate.

Rogues are plain Zenoh clients, so that no code of cpnet limits them. What they publish is no valid
message: wherever it arrived, it would be counted among the run's drops.
"""

import json
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pytest
import zenoh

from protocol.access import Keys
from protocol.bus import Endpoint, open_bus
from protocol.inbox import Inbox
from protocol.messages import Setup
from protocol.topics import ALIVE, PREFIX, TOPICS, BusName
from tests.certificates import make_keys
from tests.cpnet.commands import Command, Shell, free_ports
from tests.waiting import TIMEOUT_S, wait_until

pytestmark = pytest.mark.process

FORGED = b"forged"
V2X, WORLD = BusName.V2X, BusName.WORLD
ALLOWED = {V2X: "r0/roster/vehicle-1", WORLD: "metrics/vehicle-1"}
FORBIDDEN = {
    V2X: [
        "r0/scan/vehicle-0/rsu-0/0",
        "r0/scan/infra-r0/rsu-0/0",
        "r0/pose/vehicle-0/x",
        "r0/objects/vehicle-0/x",
        "r0/roster/infra-r0",
        "r0/roster/vehicle-0",
        "r0/lanes/J",
        "r0/detections",
        "r0/plan/rsu-0",
        "signal/J/request",
        "signal/J/state",
        "metrics/vehicle-1",
    ],
    WORLD: [
        "world/tick",
        "world/truth",
        "world/trips",
        "world/end",
        "world/progress",
        "world/clock/vehicle-0",
        "metrics/vehicle-0",
        "metrics/edge",
    ],
}
FENCE = {V2X: "r0/scan/vehicle-1/x/0", WORLD: "world/clock/vehicle-1"}
"""Keys that the rogue may publish to and a recorder receives: published last, they arrive last."""

OWN_MESSAGES = 3


@dataclass
class Received:
    """What a client received, by key."""

    samples: list[zenoh.Sample] = field(default_factory=list)

    def take(self, sample: zenoh.Sample) -> None:
        self.samples.append(sample)

    def names(self) -> set[str]:
        return {str(s.key_expr).removeprefix(f"{PREFIX}/") for s in self.samples}

    def forged(self) -> list[str]:
        return [str(s.key_expr) for s in self.samples if s.payload.to_bytes() == FORGED]

    def has(self, key: str, times: int) -> bool:
        return self.forged().count(key) == times

    def some(self, key: str, least: int = 1) -> bool:
        return sum(str(s.key_expr).endswith(key) for s in self.samples) >= least


class Run:
    """A run with keys in realtime, and clients of its buses."""

    def __init__(self, shell: Shell) -> None:
        self.shell = shell
        self.port = free_ports()
        self.keys = make_keys(shell.folder / "keys")
        self.stranger = make_keys(shell.folder / "stranger")
        self._sessions: list[zenoh.Session] = []

    def start(self) -> Command:
        place = f"--listen=127.0.0.1:{self.port}"
        options = ("--mode=realtime", "--duration=600", "--cav-rate=0.1", "--out=run")
        command = self.shell.up(*options, "--keys=keys", place)
        command.read_until("vehicles")
        return command

    def locator(self, bus: BusName, protocol: str = "tls") -> str:
        return f"{protocol}/127.0.0.1:{self.port + (bus is WORLD)}"

    def client(
        self, bus: BusName, keys: Keys | None, mode: str = "client", timeout_s: float = 2.0
    ) -> zenoh.Session:
        """Connects; with the files of another or without.

        Raises:
            zenoh.ZError: the other side refuses it.
        """
        config = zenoh.Config()
        settings = {
            "mode": mode,
            "connect/endpoints": [self.locator(bus)],
            "connect/timeout_ms": round(timeout_s * 1e3),
            "connect/exit_on_failure": True,
            "listen/endpoints": [],
            "scouting/multicast/enabled": False,
            "transport/link/tls": keys.settings() if keys else self._bare(),
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        session = zenoh.open(config)
        self._sessions.append(session)
        return session

    def member(self, bus: BusName, process_id: str, mode: str = "client") -> zenoh.Session:
        return self.client(bus, Keys.of(self.keys, process_id), mode, TIMEOUT_S)

    def spy(self, bus: BusName) -> Received:
        """Subscribes to all that a recorder may receive, as a recorder."""
        received, session = Received(), self.member(bus, "record")
        for topic in TOPICS.values():
            if topic.bus is bus and "record" in topic.subscribers:
                session.declare_subscriber(topic.key(region="r0"), received.take)
        return received

    def leave(self) -> None:
        for session in self._sessions:
            session.close()
        self._sessions.clear()

    def _bare(self) -> dict[str, str]:
        return {"root_ca_certificate": str(self.keys / "ca.pem")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rogue")


@pytest.fixture(scope="module")
def run(folder: Path) -> Iterator[Run]:
    """Returns a run that goes on; the last test of a worker need not be the last one here."""
    shell = Shell(folder)
    made = Run(shell)
    made.start()
    yield made
    made.leave()
    shell.stop_all()


@pytest.fixture
def attacked(run: Run) -> Iterator[Run]:
    yield run
    run.leave()


@pytest.mark.parametrize("bus", BusName)
def test_nobody_connects_without_a_certificate_of_the_authority(attacked, bus):
    mixed = Keys(
        attacked.keys / "ca.pem",
        attacked.stranger / "vehicle-1.pem",
        attacked.stranger / "vehicle-1.key",
    )
    strangers = [Keys.of(attacked.stranger, name) for name in ("vehicle-1", "sim")]
    with ThreadPoolExecutor() as pool:  # each tries for as long as it may
        tries = [pool.submit(attacked.client, bus, keys) for keys in (None, *strangers, mixed)]
    for one in tries:
        with pytest.raises(zenoh.ZError):
            one.result()


def test_an_agent_hears_neither_truth_nor_counts_nor_what_other_agents_upload(attacked):
    rogue = attacked.member(V2X, "vehicle-1")
    seen, truth = Received(), attacked.spy(WORLD)
    counts = attacked.spy(V2X)
    for key in ("cpnet/v4/**", "**", "cpnet/v4/world/**"):
        rogue.declare_subscriber(key, seen.take)
    for name in ("scan", "pose", "roster", "lanes", "detections", "request", "state"):
        rogue.declare_subscriber(TOPICS[name].key(), seen.take)
        rogue.declare_subscriber(TOPICS[name].key(region="r0", tls="J"), seen.take)
    world = attacked.member(WORLD, "vehicle-1")
    world.declare_subscriber("cpnet/v4/**", seen.take)
    for name in ("truth", "sighting", "trips", "metrics", "clock", "tick"):
        world.declare_subscriber(TOPICS[name].key(), seen.take)
    # The tick, which it may receive, was subscribed to last: all else was refused before that.
    wait_until(lambda: seen.some("world/tick", 5))
    wait_until(lambda: counts.some("r0/lanes/J", 20) and truth.some("world/truth", 20))
    assert seen.names() == {"world/tick"}


@pytest.mark.parametrize("bus", BusName)
def test_the_supervisor_of_an_agents_machine_hears_how_the_run_goes_and_no_more(attacked, bus):
    rogue, seen, others = attacked.member(bus, "watch"), Received(), attacked.spy(bus)
    for topic in TOPICS.values():
        if topic.bus is bus:
            rogue.declare_subscriber(topic.key(), seen.take)
            rogue.declare_subscriber(topic.key(region="r0", tls="J"), seen.take)
    wait_until(lambda: len(others.samples) > 200)  # all its subscriptions were handled meanwhile
    if bus is WORLD:
        wait_until(lambda: seen.some("world/progress", 2))
    first = {name.partition("/")[0] for name in seen.names()} - {"world"}
    assert first <= ({"metrics"} if bus is WORLD else set())
    assert {name for name in seen.names() if name.startswith("world/")} <= {"world/progress"}


def test_an_agent_sees_nobodys_presence_and_shows_nobody_elses(attacked):
    rogue, looker = (attacked.member(V2X, "vehicle-1") for _ in range(2))
    sim, scans = attacked.member(V2X, "sim"), attacked.spy(V2X)
    seen, shown = Received(), Received()
    sim.liveliness().declare_subscriber(f"{ALIVE}/*/*", shown.take, history=True)
    wait_until(lambda: shown.some("vehicle/vehicle-0"))
    looker.liveliness().declare_subscriber(f"{ALIVE}/**", seen.take, history=True)
    assert list(looker.liveliness().get(f"{ALIVE}/**", timeout=0.5)) == []
    tokens = [f"{ALIVE}/{who}" for who in ("vehicle/vehicle-9", "edge/vehicle-1", "infra/infra-7")]
    kept = [rogue.liveliness().declare_token(token) for token in tokens]
    rogue.put(f"{PREFIX}/{FENCE[V2X]}", FORGED, priority=zenoh.Priority.BACKGROUND)
    wait_until(lambda: scans.some(FENCE[V2X]))  # what it published before has been handled
    fence = attacked.member(V2X, "relay-vehicle").liveliness()
    kept.append(fence.declare_token(f"{ALIVE}/relay/relay-vehicle"))
    wait_until(lambda: shown.some("relay/relay-vehicle"))
    assert {key.removeprefix("alive/") for key in shown.names()} == {
        *(f"vehicle/vehicle-{n}" for n in range(2)),
        *(f"{name}/{name}" for name in ("record", "router", "sim")),
        "edge/edge-r0",
        "signal/signal-r0",
        "infra/infra-r0",
        "relay/relay-vehicle",
    }
    assert seen.samples == []
    assert kept


def test_nobody_answers_in_the_place_of_the_world(attacked):
    rogue = attacked.member(WORLD, "vehicle-1")
    key = TOPICS["setup"].key()
    false = rogue.declare_queryable(key, lambda query: query.reply(key, FORGED))
    watch = Endpoint(attacked.locator(WORLD), False, Keys.of(attacked.keys, "watch"))
    for _ in range(5):
        with closing(open_bus(WORLD, watch, Inbox())) as asking:
            setup = asking.ask("setup", Setup, TIMEOUT_S)
        assert setup is not None
        assert setup.scenario["name"] == "t_junction"
    assert false


def attack(rogue: zenoh.Session, bus: BusName) -> None:
    """Publishes what is forbidden, then a little of what is allowed."""
    for _ in range(OWN_MESSAGES):
        for key in FORBIDDEN[bus]:
            for priority in (zenoh.Priority.DATA_LOW, zenoh.Priority.REAL_TIME):
                rogue.put(f"{PREFIX}/{key}", FORGED, priority=priority)
            rogue.delete(f"{PREFIX}/{key}")
        rogue.put(f"{PREFIX}/{ALLOWED[bus]}", FORGED)
    rogue.put(f"{PREFIX}/{FENCE[bus]}", FORGED, priority=zenoh.Priority.BACKGROUND)


@pytest.mark.parametrize("bus", BusName)
def test_an_agent_that_calls_itself_a_router_can_say_no_more(attacked, bus):
    received = attacked.spy(bus)
    attack(attacked.member(bus, "vehicle-1", "router"), bus)
    wait_until(lambda: len(received.samples) > 100)  # seconds of the run, which goes on
    assert set(received.forged()) <= {f"{PREFIX}/{key}" for key in (FENCE[bus], ALLOWED[bus])}


def test_what_an_agent_says_under_another_name_arrives_nowhere_and_the_run_goes_on(tmp_path):
    shell = Shell(tmp_path)
    run = Run(shell)
    command = run.start()
    try:
        received = {bus: run.spy(bus) for bus in BusName}
        for rounds, mode in enumerate(("client", "peer"), 1):
            for bus in BusName:
                attack(run.member(bus, "vehicle-1", mode), bus)
                fence = f"{PREFIX}/{FENCE[bus]}"
                wait_until(partial(received[bus].has, fence, rounds))
        wait_until(lambda: received[V2X].some("r0/lanes/J", 30))
        forged = {
            bus: {k.removeprefix(f"{PREFIX}/") for k in received[bus].forged()} for bus in BusName
        }
        assert forged[V2X] == {FENCE[V2X]}
        assert forged[WORLD] == {FENCE[WORLD], "metrics/vehicle-1"}
    finally:
        run.leave()
        command.process.send_signal(signal.SIGINT)
        status, output = command.finish()
    assert status == 128 + signal.SIGINT, output
    summary = json.loads(shell.run("report", "run", "--json")[1])
    bad = {
        who: n["MessageError"]
        for who, n in summary["drops_by_reason"].items()
        if "MessageError" in n
    }
    # Its own rosters and scans reach the edge; scans, clocks and metrics the recorder.
    assert bad == {"edge-r0": 2 * (OWN_MESSAGES + 1), "record": 2 * (OWN_MESSAGES + 2)}
    assert summary["frames"] > 20
