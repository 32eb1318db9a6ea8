"""`scripts/misbehaviour`: attacks detected, time until then, false alarms; and its table.

Honest runs are recorded once, scan by scan; then one agent after the other is made to send false
data, all others staying as they were.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape

from cpnet.cli_options import AsJson, Override, assigned, errors, show_measured
from cpnet.scenario import load
from edge_server.config import EdgeConfig
from edge_server.frame import Chunk, Frame, FrameState
from edge_server.misbehaviour import Check
from edge_server.placing import Place
from edge_server.scenario import places_of
from perception.roadway import Roadway
from protocol.errors import CpnetError
from protocol.regions import RegionMap
from protocol.roadmap import RoadMap
from recording.run import Run
from studies.bench import JsonRow, empty_table, print_whole
from studies.in_process import run_in_process
from tests.misbehaviour.attacks import (
    GHOST,
    Attack,
    Displaced,
    Emptied,
    GhostReport,
    Peopled,
    Replayed,
)
from tests.misbehaviour.playback import frames_of

HONEST = "none"
WINDOW_S = 6.0  # of an attack
WAIT_S = 3.0  # before a jump
REPLAY_S = 10.0
MOST_VICTIMS = 8
THIN = 3

Attacks = dict[str, Callable[[int], Attack]]


@dataclass(frozen=True, slots=True)
class MisbehaviourRow(JsonRow):
    """An attack, at a share of CAVs: how often it was detected, and after how long (median).

    `others_s` is for how long honest agents were excluded meanwhile; `hours` is the time for which
    agents were checked, of all together.
    """

    cav_rate: float
    attack: str
    tried: int
    found: int
    after_s: float | None
    others_s: float
    hours: float


def attacks_on(road_map: RoadMap, period_s: float) -> Attacks:
    """Returns what is tried, by name; each is begun anew, at a frame."""
    moved: dict[str, dict[str, Any]] = {
        **{f"{m} m sideways": {"across_m": m} for m in (2, 3, 5, 10)},
        **{f"{m} m along": {"along_m": m} for m in (2, 3, 5, 10)},
        **{f"turned by {a} deg": {"yaw_deg": a} for a in (5, 15, 45)},
        "tilted by 5 deg": {"roll_deg": 5},
        "raised by 1 m": {"up_m": 1},
    }
    jump = round(WAIT_S / period_s)
    return {
        **{name: _displaced(keys) for name, keys in moved.items()},
        "jumps 10 m along": lambda begin: Displaced(along_m=10.0, from_frame=begin + jump),
        "cloud of 10 s ago": lambda _: Replayed(round(REPLAY_S / period_s)),
        "no points": lambda _: Emptied(),
        "3 cars that are not": lambda _: Peopled(road_map, 3),
        "ghost CV, 0.5 m": lambda _: GhostReport(road_map, 0.5),
        "ghost CV, 1.5 m": lambda _: GhostReport(road_map, 1.5),
    }


def _displaced(keys: dict[str, Any]) -> Callable[[int], Attack]:
    return lambda _: Displaced(**keys)


class RecordedRun:
    """A run's frames, thinned, on which attacks are tried."""

    def __init__(self, run_dir: Path) -> None:
        """Reads a run that kept every scan.

        Raises:
            ConfigError: the folder is no run.
        """
        with Run(run_dir) as run:
            scenario, self.road_map = run.scenario, run.setup.road_map
        self._config = EdgeConfig.model_validate(scenario["edge"])
        self._mounts = places_of(scenario["roadside_mounts"], self.road_map)
        self._roadway = Roadway.of(self.road_map, margin_m=self._config.geofence.margin_m)
        self._place = Place(self._roadway, self._config.geofence)
        self.cav_rate = float(scenario["traffic"]["cav_rate"])
        self.period_s = float(scenario["frame_period_s"])
        self.frames = [_thinned(frame) for frame in frames_of(run_dir)]

    def honest(self) -> MisbehaviourRow:
        """Checks all frames unchanged."""
        out = sum(len(lost) for _, lost in self._judge(self.frames, None, ""))
        spoken = sum(len(frame.agents) for frame in self.frames)
        hours = spoken * self.period_s / 3600
        return MisbehaviourRow(self.cav_rate, HONEST, 0, 0, None, out * self.period_s, hours)

    def tried(self, name: str, make: Callable[[int], Attack]) -> MisbehaviourRow:
        """Tries an attack by one agent after the other."""
        seen, window = self._victims(name), round(WINDOW_S / self.period_s)
        after_s, others, spoken = [], 0, 0
        for victim, first in seen:
            begin = first + (round(REPLAY_S / self.period_s) if "ago" in name else 0)
            lead = round(WAIT_S / self.period_s) if "jump" in name else 0
            frames = self.frames[first : begin + lead + window]
            liar = GHOST if "ghost" in name else victim
            found = None
            for number, lost in self._judge(frames, make(first), victim):
                others += len(lost - {liar})
                if liar in lost and found is None and number >= begin + lead:
                    found = number - begin - lead + 1
            spoken += sum(len(frame.agents) for frame in frames)
            if found is not None:
                after_s.append(found * self.period_s)
        middle = float(np.median(after_s)) if after_s else None
        hours = spoken * self.period_s / 3600
        lost_s = others * self.period_s
        return MisbehaviourRow(self.cav_rate, name, len(seen), len(after_s), middle, lost_s, hours)

    def _judge(
        self, frames: Sequence[Frame], attack: Attack | None, victim: str
    ) -> Iterator[tuple[int, set[str]]]:
        """Yields each frame's number and the agents excluded from it."""
        region = RegionMap.whole(self.road_map)
        check = Check(region, self._roadway, self._config.misbehaviour, self._mounts)
        for honest in frames:
            frame = self._placed(honest)
            if attack is not None:
                frame = self._placed(attack.apply(frame, victim))
            state = FrameState(frame)
            check.run(state)
            yield frame.frame, set(frame.agents) - set(state.frame.agents)

    def _victims(self, name: str) -> list[tuple[str, int]]:
        """Returns agents that scan all through a window, and the first frame of it."""
        if "ghost" in name:
            chosen = sorted(self._mounts)
            starts = np.linspace(0, len(self.frames) - 1, 5).astype(int)[:-1]
            return [(post, int(start)) for post in chosen for start in starts]
        need = round((WINDOW_S + WAIT_S) / self.period_s)
        need += round(REPLAY_S / self.period_s) if "ago" in name else 0
        present: dict[str, list[int]] = {}
        for frame in self.frames:
            for agent in {chunk.agent for chunk in frame.chunks} - self._mounts.keys():
                present.setdefault(agent, []).append(frame.frame)
        fit = [(agent, at) for agent, at in sorted(present.items()) if len(at) >= need]
        every = max(-(-len(fit) // MOST_VICTIMS), 1)
        return [(agent, at[(len(at) - need) // 2]) for agent, at in fit[::every]]

    def _placed(self, frame: Frame) -> Frame:
        chunks = [c if c.placed is not None else self._placed_chunk(c) for c in frame.chunks]
        return replace(frame, chunks=chunks)

    def _placed_chunk(self, chunk: Chunk) -> Chunk:
        """Places a chunk but keeps its points in the sensor frame: an attack may move them."""
        return replace(self._place.run(chunk), points=chunk.points)


def _thinned(frame: Frame) -> Frame:
    """Keeps every third point: a run's clouds have to fit into memory."""
    chunks = [replace(p, points=np.ascontiguousarray(p.points[::THIN])) for p in frame.chunks]
    return replace(frame, chunks=chunks)


def measure_misbehaviour(scenarios: Sequence[dict[str, Any]]) -> Iterator[MisbehaviourRow]:
    """Yields the rows of each scenario, honest agents first; scenarios keep every scan.

    Raises:
        ConfigError: a scenario cannot be played.
    """
    for scenario in scenarios:
        with tempfile.TemporaryDirectory(prefix="cpnet-bench-") as name:
            run_in_process(scenario, Path(name))
            yield from measure_run(Path(name))


def measure_run(run_dir: Path) -> Iterator[MisbehaviourRow]:
    """Yields the rows of a run that kept every scan.

    Raises:
        ConfigError: the folder is no run.
    """
    run = RecordedRun(run_dir)
    yield run.honest()
    for name, make in attacks_on(run.road_map, run.period_s).items():
        yield run.tried(name, make)


def print_misbehaviour(rows: list[MisbehaviourRow], console: Console) -> None:
    """Prints a line for each attack at each share of CAVs; honest agents first."""
    heads = ("CAVs", "tried", "detected", "after s", "others excluded, s", "agent-hours")
    table = empty_table(["what an agent sends", *heads])
    for row in rows:
        is_honest = row.attack == HONEST
        table.add_row(
            "the truth" if is_honest else row.attack,
            f"{row.cav_rate:g}",
            "" if is_honest else str(row.tried),
            "" if is_honest else str(row.found),
            "" if row.after_s is None else f"{row.after_s:.1f}",
            f"{row.others_s:.1f}",
            f"{row.hours:.3f}",
        )
    print_whole(table, console)
    console.print(
        "detected: excluded within 6 s, after so long (median); others: honest agents, summed",
        style="dim",
    )


def main(
    *,
    cav_rates: Annotated[
        list[float] | None, typer.Option(help="share of CAVs; may be given several times")
    ] = None,
    seconds: Annotated[float, typer.Option(min=15, max=600, help="of each run")] = 40,
    seed: Annotated[int, typer.Option(min=0, help="of the traffic")] = 1,
    overrides: Override = None,
    as_json: AsJson = False,
) -> None:
    """Measure how soon the edge detects an agent that errs or lies, and its false alarms."""
    try:
        scenarios = []
        for rate in cav_rates or [0.05, 0.3]:
            keys = assigned(overrides) | {
                "seed": seed,
                "mode": "lockstep",
                "duration_s": seconds,
                "traffic.cav_rate": rate,
            }
            keys["record.snapshot_period_s"] = load("t_junction", keys).frame_period_s
            scenarios.append(load("t_junction", keys).model_dump(mode="json"))
        show_measured(measure_misbehaviour(scenarios), None, print_misbehaviour, as_json=as_json)
    except CpnetError as error:
        errors.print(f"[bold red]error[/] {escape(str(error))}", soft_wrap=True)
        raise typer.Exit(2) from None


if __name__ == "__main__":
    typer.run(main)
