import socket

import pytest

from cpnet.endpoints import connecting, implies_world, resolve
from protocol.bus import Endpoint
from protocol.errors import ConfigError
from protocol.topics import BusName

V2X, WORLD = BusName.V2X, BusName.WORLD


def test_without_options_both_buses_get_free_ports_on_loopback():
    places = resolve([], [], {V2X, WORLD})
    assert all(e.listen and e.locator.startswith("tcp/127.0.0.1:") for e in places.values())
    assert places[V2X] != places[WORLD]


def test_a_bare_address_means_the_v2x_bus_and_the_world_bus_one_port_above():
    places = resolve([], ["10.0.0.1:7447"], set())
    assert places[V2X] == Endpoint("tcp/10.0.0.1:7447", listen=False)
    assert places[WORLD] == Endpoint("tcp/10.0.0.1:7448", listen=False)


def test_each_bus_can_have_a_place_of_its_own():
    places = resolve([], ["v2x=edge.city:7447", "world=tcp/[fe80::1]:9000"], set())
    assert places[V2X].locator == "tcp/edge.city:7447"
    assert places[WORLD].locator == "tcp/[fe80::1]:9000"


@pytest.mark.parametrize(
    ("texts", "implied"),
    [
        (["a:7447"], True),
        (["[::1]:7447"], True),
        (["a:7447", "v2x=b:7447"], True),
        (["a:7447", "world=b:7448"], False),
        (["v2x=a:7447"], False),
        ([], False),
    ],
)
def test_a_world_bus_that_nobody_named_is_told_from_one_that_was(texts, implied):
    assert implies_world(texts) is implied


def test_a_bus_whose_host_runs_elsewhere_needs_a_place():
    with pytest.raises(ConfigError, match="world bus lives where the role sim runs.*--connect"):
        resolve([], [], {V2X})


@pytest.mark.parametrize("text", ["7447", "host:", "host:0", "host:70000", "udp=h:1", "a b:1"])
def test_a_locator_that_cannot_be_read_is_refused_with_the_form(text):
    with pytest.raises(ConfigError, match=r"--listen .*needs HOST:PORT"):
        resolve([text], [], {V2X, WORLD})


def test_a_port_in_use_is_named():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"port {port}: Address already in use"):
            resolve([f"v2x=127.0.0.1:{port}"], [], {V2X, WORLD})


def test_processes_of_the_same_machine_do_not_connect_to_a_wildcard():
    endpoint = Endpoint("tcp/0.0.0.0:7447", listen=True)
    assert connecting(endpoint) == Endpoint("tcp/127.0.0.1:7447", listen=False)
