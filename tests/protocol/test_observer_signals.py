"""An observer that waits for a run that is not there can be stopped by a signal."""

import signal
import subprocess
import sys
import time

import pytest

from cpnet.endpoints import free_locator
from protocol.bus import Endpoint, open_bus
from protocol.errors import BusError
from protocol.inbox import Inbox
from protocol.observer import Observer
from protocol.topics import BusName

pytestmark = pytest.mark.process

WAITER = """
import sys
from protocol.bus import Endpoint
from protocol.observer import Observer
v2x, world = (Endpoint(place, listen=False) for place in sys.argv[1:])
print("looking", flush=True)
try:
    with Observer(v2x, world, timeout_ms=60_000) as observer:
        observer.setup(60)
except KeyboardInterrupt:
    sys.exit(130)
"""
AT_ONCE_S = 8.0  # on a loaded machine; an ignored signal takes 60


@pytest.mark.parametrize("is_up", [False, True])
def test_a_signal_ends_the_wait_for_the_buses_and_for_the_setup(is_up):
    places = [free_locator(), free_locator()]
    hosts = [
        open_bus(name, Endpoint(place, listen=True), Inbox())
        for name, place in zip((BusName.V2X, BusName.WORLD), places, strict=True)
        if is_up
    ]
    try:
        with subprocess.Popen(
            [sys.executable, "-c", WAITER, *places], stdout=subprocess.PIPE, text=True
        ) as waiter:
            assert waiter.stdout is not None
            waiter.stdout.readline()
            time.sleep(1.0)  # into the call to Zenoh, which nothing outside shows
            waiter.send_signal(signal.SIGINT)
            try:
                assert waiter.wait(AT_ONCE_S) == 130
            finally:
                waiter.kill()
    finally:
        for host in hosts:
            host.close()


def test_a_bus_that_is_not_there_is_named_with_the_whole_wait():
    endpoint = Endpoint(free_locator(), listen=False)
    with pytest.raises(BusError, match=r"nothing answers at .* \(waited 0\.3 s\)"):
        Observer(endpoint, endpoint, timeout_ms=300)
