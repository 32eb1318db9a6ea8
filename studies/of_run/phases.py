"""What the signal showed, and the pressures that led to it."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import groupby

from protocol.errors import ConfigError
from protocol.roadmap import Signal
from recorder.run import Run
from recorder.tables import PhaseRow, RequestRow
from studies import palette
from studies.of_run.clock import TIME, Clock, over_time
from studies.page.charts import Chart, Span, Timeline
from studies.page.model import Block, Section, Text
from studies.thin import line

_LONGEST = 28  # letters of a phase's name
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


class PhaseNames:
    """Phases by a letter and the edges that they let go; the plan's come first."""

    def __init__(self, run: Run) -> None:
        try:
            self._signal: Signal | None = run.setup.road_map.signal
        except ConfigError:  # cut off before its setup was written, or moved without it
            self._signal = None
        self.greens = self._signal.greens if self._signal else []

    def __getitem__(self, green: str) -> str:
        """Returns the name of a green state; one that the plan lacks takes the next letter."""
        if green not in self.greens:
            self.greens.append(green)
        number = self.greens.index(green)
        letter = _LETTERS[number] if number < len(_LETTERS) else str(number)
        return f"{letter}: {self._edges(green)}"

    def _edges(self, green: str) -> str:
        links = self._signal.links if self._signal else []
        lanes = [k.from_lane for k in links if k.index < len(green) and green[k.index] in "Gg"]
        edges = ", ".join(dict.fromkeys(lane.rpartition("_")[0] or lane for lane in lanes))
        text = edges or green
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def phases_section(run: Run, clock: Clock) -> Section:
    """Returns phases over time, and pressures."""
    names = PhaseNames(run)
    blocks: list[Block] = []
    spans = _spans(list(run.rows(PhaseRow)), names, clock)
    if spans:
        rows = tuple(sorted(dict.fromkeys(span.row for span in spans)))
        blocks.append(Timeline("Phases", TIME, rows, tuple(spans), palette.LAMPS))
    else:
        blocks.append(Text("No signal state was recorded."))
    pressures = _pressures(run, names, clock)
    blocks.append(pressures or Text("No pressures were recorded: the policy does not weigh any."))
    return Section("Signal", tuple(blocks))


def _spans(rows: list[PhaseRow], names: PhaseNames, clock: Clock) -> list[Span]:
    """Returns how long each stage lasted, of all signals."""
    rows = sorted(rows, key=lambda row: (row.tls, row.frame))
    many = len({row.tls for row in rows}) > 1
    spans: list[Span] = []
    for tls, shown in groupby(rows, key=lambda row: row.tls):
        spans += _of_signal(list(shown), names, clock, f"{tls} " if many else "")
    return spans


def _of_signal(rows: list[PhaseRow], names: PhaseNames, clock: Clock, prefix: str) -> list[Span]:
    """Returns one signal's stages; yellow and all-red stand with the green that they end."""
    spans: list[Span] = []
    present = ""
    for (stage, green), group in groupby(rows, key=lambda row: (row.stage, row.green)):
        first = next(group)
        if stage == "green" or not present:
            present = green
        start_s = clock[first.frame]
        if spans:
            spans[-1] = replace(spans[-1], end=start_s)
        row = prefix + names[present]
        spans.append(Span(row, start_s, start_s, stage.replace("_", " ")))
    if spans:
        spans[-1] = replace(spans[-1], end=clock[rows[-1].frame] + clock.period_s)
    return spans


def _pressures(run: Run, names: PhaseNames, clock: Clock) -> Chart | None:
    x: list[float] = []
    table: list[list[float]] = []
    for row in run.rows(RequestRow):
        values = _parsed(row.pressures)
        if values and len(values) == len(names.greens):
            x.append(clock[row.frame])
            table.append(values)
    if not table:
        return None
    series = tuple(
        line(names[green], x, [values[i] for values in table])
        for i, green in enumerate(names.greens)
    )
    return over_time("Pressure of each phase", "vehicles", series, kind="steps")


def _parsed(text: str) -> list[float]:
    try:
        values = json.loads(text)
    except ValueError:
        return []
    is_list = isinstance(values, list) and all(isinstance(v, int | float) for v in values)
    return [float(v) for v in values] if is_list else []
