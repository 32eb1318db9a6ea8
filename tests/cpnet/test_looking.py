"""Commands that look on at a run say what they wait for, if that takes a while."""

import io
import time

import pytest
from rich.console import Console

from cpnet import looking
from cpnet.looking import looking_for
from cpnet.running import Running
from protocol.bus import Endpoint
from tests.waiting import wait_until

RUN = Running(Endpoint("tcp/far:1", listen=False), Endpoint("tcp/far:2", listen=False))


@pytest.mark.parametrize("is_slow", [True, False])
def test_only_a_wait_that_lasts_is_told_of(monkeypatch, is_slow):
    monkeypatch.setattr(looking, "TELL_AFTER_S", 0.01 if is_slow else 0.3)
    said = io.StringIO()
    with looking_for(RUN, Console(file=said)):
        if is_slow:
            wait_until(lambda: "looking for the run at tcp/far:1 and tcp/far:2" in said.getvalue())
    time.sleep(0 if is_slow else 0.4)
    assert bool(said.getvalue()) is is_slow
