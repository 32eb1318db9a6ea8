"""`cpnet keys`, and the errors of `cpnet up --keys` for invalid keys."""

import json
import shutil
import stat
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh

from cpnet.cli_setup import keys_command
from cpnet.endpoints import free_locator
from cpnet.keys import ROUTER, router_config
from cpnet.processes import parse_only
from cpnet.security import check_key, check_keys_of_roles, secured_endpoints
from protocol.access import Keys
from protocol.bus import Endpoint, open_bus
from protocol.errors import ConfigError
from protocol.inbox import Envelope, Inbox, Presence
from protocol.messages import Roster
from protocol.topics import BusName
from tests.certificates import make_keys
from tests.cpnet.commands import Shell

BUSES = set(BusName)
NOBODY_ELSE = "without keys anybody on that network could read and forge"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_keys(
        tmp_path_factory.mktemp("authority") / "keys", hosts=["router.city", "10.0.0.7"]
    )


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """Returns a copy that a test may spoil."""
    return Path(shutil.copytree(made, tmp_path / "keys"))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_each_process_has_a_certificate_and_private_keys_are_private(made):
    ids = ["router", "sim", "record", "edge-r0", "signal-r0", "infra-r0", "watch", "vehicle-0"]
    for name in ids:
        check_key(made, name, hosts=name in ("router", "sim"))
    modes = {stat.S_IMODE(path.stat().st_mode) for path in made.glob("*.key")}
    assert modes == {0o600}


def test_an_agents_certificate_cannot_host_a_bus(made):
    with pytest.raises(ConfigError, match=r"vehicle-0.pem: unsuitable certificate purpose"):
        check_key(made, "vehicle-0", hosts=True)


def test_a_second_call_adds_what_is_missing_by_the_same_authority(shell: Shell, folder):
    before = contents(folder)
    status, output = shell.run("keys", "keys", "--vehicles", "4")
    assert (status, "keys: made vehicle-2, vehicle-3" in output) == (0, True), output
    after = contents(folder)
    assert {name: after[name] for name in before} == before
    check_key(folder, "vehicle-3")
    assert "nothing, all is there" in shell.run("keys", "keys")[1]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "ca.key").unlink(), "only where the authority was made"),
        (lambda f: (f / "ca.pem").unlink(), "only where the authority was made"),
        (lambda f: (f / "ca.key").write_text("x"), "cannot be read"),
        (lambda f: (f / "ca.key").write_bytes((f / "sim.key").read_bytes()), "is not the key of"),
        (lambda f: [p.unlink() for p in f.glob("ca.*")], "holds something, but no authority"),
        (lambda f: (f / "ca.pem").write_bytes(b""), "cannot be read"),
    ],
)
def test_an_authority_is_never_made_over(folder, spoil, message):
    spoil(folder)
    (folder / "vehicle-1.pem").unlink()
    before = contents(folder)
    with pytest.raises(ConfigError, match=message):
        make_keys(folder)
    assert contents(folder) == before


def test_a_host_that_an_older_certificate_does_not_name_is_refused(folder):
    make_keys(folder, hosts=["10.0.0.7", "router.city"])
    with pytest.raises(ConfigError, match=r"router.pem: is there already and does not name b.city"):
        make_keys(folder, hosts=["b.city"])
    for name in ("router", "sim"):
        (folder / f"{name}.pem").unlink()
    make_keys(folder, hosts=["b.city"])


def test_without_the_extra_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    monkeypatch.delitem(sys.modules, "cpnet.keys", raising=False)
    with pytest.raises(ConfigError, match=r"\(extra `keys`\): .* -m pip install 'cryptography>="):
        keys_command(tmp_path / "keys", vehicles=1, days=1)
    assert not (tmp_path / "keys").exists()


@pytest.mark.parametrize("name", ["köln", "a b", "http://a:1", "*", "", "-a", "a..b", "a" * 70])
def test_a_name_that_no_host_can_have(tmp_path, name):
    with pytest.raises(ConfigError, match="needs a name such as edge"):
        make_keys(tmp_path / "keys", hosts=[name])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda f: (f / "router.pem").unlink(),
            "router.pem: there is no such file, and router runs",
        ),
        (lambda f: (f / "router.key").unlink(), "router.key: there is no such file"),
        (lambda f: (f / "ca.pem").unlink(), "ca.pem: there is no such file"),
        (lambda f: (f / "ca.pem").write_text("x"), "ca.pem: holds no certificate"),
        (lambda f: (f / "router.pem").write_text("x"), "is no PEM file of a certificate"),
        (lambda f: shutil.copy(f / "sim.key", f / "router.key"), "its key is not .*router.key"),
        (
            lambda f: [
                shutil.copy(f / f"sim.{end}", f / f"router.{end}") for end in ("pem", "key")
            ],
            "router.pem: is the certificate of 'sim', not 'router'",
        ),
    ],
)
def test_files_that_are_not_what_their_names_say(folder, spoil, message):
    spoil(folder)
    with pytest.raises(ConfigError, match=message):
        check_key(folder, "router", hosts=True)


def test_a_certificate_of_another_authority_is_named(folder, tmp_path):
    other = make_keys(tmp_path / "other")
    for end in ("pem", "key"):
        shutil.copy(other / f"router.{end}", folder / f"router.{end}")
    with pytest.raises(ConfigError, match=r"router.pem: is not by the authority of .*ca.pem"):
        check_key(folder, "router", hosts=True)


def test_an_expired_certificate_is_named(tmp_path):
    long_ago = datetime.now(UTC) - timedelta(days=30)
    folder = make_keys(tmp_path / "keys", days=7, now=long_ago)
    with pytest.raises(ConfigError, match=r"record.pem: certificate has expired"):
        check_key(folder, "record")


def test_an_authority_whose_time_is_over_makes_no_more(tmp_path):
    make_keys(tmp_path / "keys", now=datetime.now(UTC) - timedelta(days=4000))
    with pytest.raises(ConfigError, match=r"ca.pem: expired on 20"):
        make_keys(tmp_path / "keys", vehicles=3)


def test_keys_are_looked_at_before_anything_starts(shell: Shell, folder):
    (folder / "infra-r0.key").unlink()
    status, output = shell.run("up", "--keys", "keys", "--out", "run")
    assert (status, "keys/infra-r0.key: there is no such file" in output) == (2, True), output
    assert "Traceback" not in output
    assert not (shell.folder / "run").exists()


@pytest.mark.parametrize("named", ["vehicle-7", "signal-r0,vehicle", "infra-r0,edge"])
def test_keys_that_are_surely_needed_are_missed_before_anybody_is_asked(
    shell: Shell, folder, named
):
    missing = named.split(",")[0]
    (folder / f"{missing}.key").unlink(missing_ok=True)
    (folder / f"{missing}.pem").unlink(missing_ok=True)
    status, output = shell.run(
        "up", f"--only={named}", "--keys=keys", "--connect=127.0.0.1:1", "--out=run"
    )
    assert status == 2, output
    assert f"keys/{missing}.pem: there is no such file, and {missing} runs here" in output
    assert "waiting" not in output
    assert not (shell.folder / "run").exists()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda f: [path.unlink() for path in f.glob("vehicle-*")],
            "has no certificate of the role vehicle, which runs here",
        ),
        (lambda f: (f / "vehicle-1.key").unlink(), "vehicle-1.key: there is no such file"),
        (lambda f: (f / "vehicle-1.pem").unlink(), "vehicle-1.pem: there is no such file"),
        (
            lambda f: shutil.copy(f / "sim.key", f / "vehicle-0.key"),
            "its key is not .*vehicle-0.key",
        ),
    ],
)
def test_keys_of_a_role_that_cannot_be_are_told_without_a_world(folder, spoil, message):
    check_keys_of_roles(folder, parse_only("vehicle"))
    spoil(folder)
    check_keys_of_roles(folder, parse_only("edge,record"))  # no matter what others' are
    check_keys_of_roles(None, parse_only("vehicle"))
    with pytest.raises(ConfigError, match=message):
        check_keys_of_roles(folder, parse_only("vehicle"))


def test_another_authoritys_keys_of_a_role_are_told_without_a_world(folder, tmp_path):
    other = make_keys(tmp_path / "other")
    for end in ("pem", "key"):
        shutil.copy(other / f"edge-r0.{end}", folder / f"edge-r0.{end}")
    with pytest.raises(ConfigError, match=r"edge-r0.pem: is not by the authority of"):
        check_keys_of_roles(folder, parse_only("edge"))


def test_a_role_without_usable_keys_waits_for_nobody(shell: Shell, folder):
    (folder / "vehicle-1.key").unlink()
    status, output = shell.run(
        "up", "--only=vehicle", "--keys=keys", "--connect=127.0.0.1:1", "--restart", "--out=run"
    )
    assert status == 2, output
    assert "keys/vehicle-1.key: there is no such file" in output
    assert "waiting" not in output


@pytest.mark.parametrize("place", ["0.0.0.0:7447", "[::]:7447", "192.0.2.1:7447", "edge.city:7447"])
def test_a_bus_without_keys_stays_on_loopback(place):
    with pytest.raises(ConfigError, match=NOBODY_ELSE):
        secured_endpoints([], [place], set(), None, insecure=False)
    assert len(secured_endpoints([], [place], set(), None, insecure=True)) == 2


def test_listening_to_a_network_without_keys_is_refused(shell: Shell):
    status, output = shell.run("up", "--listen", "0.0.0.0:17447", "--out", "run")
    assert (status, NOBODY_ELSE in output) == (2, True), output
    assert "give --keys DIR" in output
    assert "or --insecure" in output
    assert not (shell.folder / "run").exists()


@pytest.mark.parametrize("place", ["127.0.0.1:7447", "127.9.9.9:7447", "[::1]:7447", "localhost:1"])
def test_loopback_needs_no_keys(place):
    assert len(secured_endpoints([], [place], set(), None, insecure=False)) == 2


def test_keys_make_every_place_one_of_tls_for_the_supervisor_too(made):
    places = secured_endpoints([], [], BUSES, made, insecure=False)
    for endpoint in places.values():
        assert endpoint.locator.startswith("tls/127.0.0.1:")
        assert endpoint.keys is not None
        assert endpoint.keys.certificate.name == "watch.pem"


def test_keys_and_insecure_contradict_each_other(made):
    with pytest.raises(ConfigError, match="has no meaning with --keys"):
        secured_endpoints([], [], BUSES, made, insecure=True)


def test_the_settings_of_another_router_hold_the_rules_of_the_certificates(shell: Shell, folder):
    status, output = shell.run("keys", "keys", "--router-config", "zenohd.json5")
    assert status == 0, output
    text = (shell.folder / "zenohd.json5").read_text()
    config = json.loads("".join(x for x in text.splitlines() if not x.startswith("//")))
    names = [subject["id"] for subject in config["access_control"]["subjects"]]
    assert "vehicle-1" in names
    assert "router" in names
    check_key(folder, "router", hosts=True)


def test_another_router_with_those_settings_lets_each_say_what_is_its_own(folder):
    make_keys(folder, more=[ROUTER])
    locator = free_locator("tls")
    config = router_config(folder) | {"listen": {"endpoints": [locator]}}
    router = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    received = Inbox()
    edge, vehicle = (
        open_bus(BusName.V2X, Endpoint(locator, False, Keys.of(folder, name)), inbox, 3000)
        for name, inbox in (("edge-r0", received), ("vehicle-0", Inbox()))
    )
    edge.subscribe("roster", region="r0")
    edge.watch()
    vehicle.announce("vehicle", "vehicle-0")
    assert received.get(5.0) == Presence("vehicle", "vehicle-0", alive=True)
    for process in ("infra-r0", "vehicle-0"):
        roster = Roster(frame=0, process=process, agents=[], scanning=[])
        vehicle.publish("roster", roster, region="r0", process=process)
    item = received.get(5.0)
    assert isinstance(item, Envelope)
    assert item.parts["process"] == "vehicle-0"
    for session in (edge, vehicle, router):
        session.close()
