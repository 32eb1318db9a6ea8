"""The progress display of a study."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from tests.studies.sweep.made_cells import cell

pytest.importorskip("distributed", reason="needs the extra `study`")

from studies.sweep.engine import Failure, ProgressDisplay, TimeLeft, duration


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (59.6, "1 min 00 s"), (125, "2 min 05 s"), (3600 * 27 + 61, "27 h 01 min")],
)
def test_times_are_told_as_people_do(seconds, text):
    assert duration(seconds) == text


def test_the_time_left_follows_from_cells_done_and_sinks_while_one_waits(monkeypatch):
    now_ns = 0
    monkeypatch.setattr("studies.sweep.engine.time.monotonic_ns", lambda: now_ns)
    pace = TimeLeft(4)
    assert pace.left() == ""
    now_ns = 10_000_000_000
    pace.step()
    assert pace.left() == "30 s left"
    now_ns += 4_000_000_000
    assert pace.left() == "26 s left"
    now_ns += 99_000_000_000
    assert pace.left() == "0 s left"


def test_without_a_terminal_there_is_a_line_for_each_cell_and_each_failure():
    printed = io.StringIO()
    with ProgressDisplay(Console(file=printed, width=40), todo=2, kept=3) as display:
        display.started(cell(1, rate=0.5))
        display.finished(cell(1, rate=0.5))
        display.failed(Failure(cell(2, name="[/x]"), "no [such] thing"))
        display.idle(0)
        display.idle(0)
    first, second, third = printed.getvalue().splitlines()
    assert first.startswith("4/5  all rate=0.5 seed=1  ")
    assert second == "failed  all name=[/x] seed=2: no [such] thing"
    assert third == "no worker is connected; the study goes on once one is"


def test_a_terminal_shows_a_bar_with_what_runs():
    printed = io.StringIO()
    console = Console(file=printed, width=100, force_terminal=True, color_system=None)
    with ProgressDisplay(console, todo=3, kept=1) as display:
        for seed in (1, 2, 3):
            display.started(cell(seed, name="[/x]"))
    assert "1/4" in printed.getvalue()
    assert "all name=[/x] seed=1; all name=[/x] seed=2 and 1 more" in printed.getvalue()
