"""Observer commands print what they wait for, if that takes a while."""

import io
import threading

from rich.console import Console

from cpnet import observe
from cpnet.discovery import RunLocation
from cpnet.observe import connecting_to
from cpnet.viewer_process import Viewing, viewed
from protocol.bus import Endpoint
from tests.waiting import wait_until

RUN = RunLocation(Endpoint("tcp/far:1", listen=False), Endpoint("tcp/far:2", listen=False))


def test_a_wait_that_lasts_is_told_of(monkeypatch):
    monkeypatch.setattr(observe, "NOTICE_AFTER_S", 0.01)
    printed = io.StringIO()
    with connecting_to(RUN, Console(file=printed)):
        wait_until(lambda: "looking for the run at tcp/far:1 and tcp/far:2" in printed.getvalue())


def test_a_short_wait_is_not_told_of_and_leaves_nothing_that_would(monkeypatch):
    monkeypatch.setattr(observe, "NOTICE_AFTER_S", 3600.0)
    printed = io.StringIO()
    before = threading.enumerate()
    with connecting_to(RUN, Console(file=printed)):
        pass
    wait_until(lambda: not {*threading.enumerate()} - {*before})
    assert printed.getvalue() == ""


def test_a_viewer_that_cannot_go_on_says_why_and_the_run_does(tmp_path):
    (tmp_path / "logs").mkdir()
    printed = io.StringIO()
    with viewed(
        tmp_path, Viewing.WEB, Console(file=printed, width=400)
    ):  # a run of which none knows
        wait_until(lambda: "the run goes on without it" in printed.getvalue())
    assert "the viewer ended with status 2" in printed.getvalue()
    assert f"{tmp_path}: no run goes on there" in printed.getvalue()
