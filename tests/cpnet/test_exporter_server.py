"""The page of metrics is served, whoever else connects."""

import socket
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from cpnet.exporter import pages
from cpnet.exporter.server import Place, serving
from protocol.errors import ConfigError
from tests.waiting import wait_until


@pytest.fixture
def place() -> Iterator[Place]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    found = Place("127.0.0.1", port)
    with serving(found):
        yield found


def scrape(place: Place) -> str:
    with urllib.request.urlopen(f"http://{place}/metrics", timeout=5) as answer:
        return answer.read().decode()


def answering() -> int:
    """How many threads serve an asker."""
    return sum("process_request_thread" in thread.name for thread in threading.enumerate())


def test_those_who_connect_and_say_nothing_keep_nobody_from_the_page(place, capfd):
    with ExitStack() as silent:
        for n in range(64):
            silent.enter_context(socket.create_connection((place.host, place.port)))
            wait_until(lambda: answering() <= pages.MAX_ASKERS, what="too many threads")
            if n % 16 == 15:
                assert "cpnet_build_info" in scrape(place)
    wait_until(lambda: not answering(), what="the threads of those who left go on")
    assert capfd.readouterr() == ("", "")


def test_whoever_asks_for_nothing_is_hung_up_on(place, monkeypatch, capfd):
    monkeypatch.setattr(pages._Handler, "timeout", 0.1)
    with socket.create_connection((place.host, place.port), timeout=5) as silent:
        assert silent.recv(1) == b""
    wait_until(lambda: not answering(), what="its thread goes on")
    assert capfd.readouterr() == ("", "")


def test_a_place_that_is_taken_meanwhile_is_told_of(place):
    with pytest.raises(ConfigError, match="cannot listen"), serving(place):
        pass
