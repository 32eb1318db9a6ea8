"""An observer may be stopped, slow or gone: no process waits for it."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from protocol.bus import Endpoint, open_bus
from protocol.inbox import Envelope, Inbox
from protocol.topics import BusName
from tests.messages import SCAN
from tests.waiting import TIMEOUT_S, wait_until

pytestmark = pytest.mark.process

OBSERVER = """
import sys
from protocol.bus import Endpoint, open_bus
from protocol.inbox import Inbox
from protocol.topics import BusName
inbox = Inbox()
bus = open_bus(BusName.V2X, Endpoint(sys.argv[1], listen=False, yields=True), inbox)
bus.subscribe("scan")
while True:
    if inbox.get(1.0) is not None:
        print("heard", flush=True)
"""
MESSAGES = 600  # of 40 kB each: more than all buffers on the way hold
ATTEMPTS_S = 60.0


@pytest.fixture
def locator() -> str:
    from cpnet.endpoints import free_locator

    return free_locator()


@pytest.fixture
def observer(locator: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", OBSERVER, locator]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        yield process
        process.kill()


def test_a_stopped_observer_holds_up_nobody(locator, request):
    router = open_bus(BusName.V2X, Endpoint(locator, listen=True), Inbox())
    received = Inbox()
    receiver = open_bus(BusName.V2X, Endpoint(locator, listen=False), received)
    receiver.subscribe("scan")
    speaker = open_bus(BusName.V2X, Endpoint(locator, listen=False), Inbox())
    observer = request.getfixturevalue("observer")
    scan = SCAN.model_copy(update={"payload": np.zeros(40_000, np.uint8)})

    def publish() -> None:
        speaker.publish("scan", scan, region="r0", process="p", agent="rsu-0", chunk="0")
        assert isinstance(received.get(TIMEOUT_S), Envelope)

    try:
        os.set_blocking(observer.stdout.fileno(), False)
        wait_until(lambda: (publish(), observer.stdout.readline())[1], ATTEMPTS_S)
        observer.send_signal(signal.SIGSTOP)
        slowest_s = 0.0
        for _ in range(MESSAGES):
            before_s = time.monotonic()
            publish()
            slowest_s = max(slowest_s, time.monotonic() - before_s)
        assert slowest_s < 2  # a router that waits does so for 5 s
        observer.send_signal(signal.SIGCONT)
        wait_until(lambda: observer.stdout.readline(), ATTEMPTS_S)
    finally:
        for bus in (speaker, receiver, router):
            bus.close()
