"""`scripts/honest`: false alarms of misbehaviour detection in honest runs on many nets.

In turn: junctions drawn as those of `cpnet dataset`, roads that cross on a bridge, and a town of
whose signals one is controlled, so that agents drive on roads that its map lacks.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from cpnet.cli_options import AsJson, Override, assigned, errors, show_measured
from cpnet.scenario import load
from protocol.errors import CpnetError
from protocol.regions import RegionMap
from recording.run import Run
from recording.tables import DropRow, TruthRow
from sensing.noise import stream
from sim_host.junctions import draw_junction, write_junction
from studies.bench import JsonRow, empty_table, print_whole
from studies.in_process import run_in_process
from studies.summary import agent_scores
from tests.bridges import write_bridge

KINDS = ("junction", "bridge", "town")
_HIGH_M = (5.5, 9.0)  # of bridges
_FAR_M = 700.0  # from the town's signal: vehicles exist far beyond its map
_TOWN_SIGNALS = ("B1", "C2", "D3", "E4")
_EXCLUDED = ("implausible_", "misaligned")


@dataclass(frozen=True, slots=True)
class HonestRow(JsonRow):
    """A run: its net, honest agents, their frames, those beyond the map, and exclusions.

    `excluded` are frames of an agent, `reasons` the same by what the edge counts them as.
    """

    run: int
    net: str
    agents: int
    agent_frames: int
    beyond_map: int
    excluded_agents: int
    excluded: int
    reasons: dict[str, int]


def honest_keys(seed: int, number: int, folder: Path) -> tuple[str, dict[str, Any]]:
    """Returns the kind of a run's net and the scenario's keys for it; the folder gets the net."""
    kind, rng = KINDS[number % len(KINDS)], stream(seed, "honest", number)
    if kind == "junction":
        net = write_junction(folder, "drawn", draw_junction(rng))
        return kind, {"traffic.net": str(net)}
    if kind == "bridge":
        net = write_bridge(folder, round(float(rng.uniform(*_HIGH_M)), 1))
        return kind, {"traffic.net": str(net), "junctions": "all"}
    signal = _TOWN_SIGNALS[int(rng.integers(len(_TOWN_SIGNALS)))]
    return kind, {
        "traffic.network": "town",
        "junctions": [signal],
        "traffic.radius_m": _FAR_M,
        "traffic.grade": 0.05,
    }


def honest_run(seed: int, number: int, keys: dict[str, Any]) -> HonestRow:
    """Plays one run.

    Raises:
        ConfigError: the scenario cannot be played.
    """
    with tempfile.TemporaryDirectory(prefix="cpnet-honest-") as name:
        folder = Path(name)
        kind, net = honest_keys(seed, number, folder)
        scenario = load("t_junction", keys | net | {"seed": seed + number, "mode": "lockstep"})
        run_dir = folder / "run"
        run_dir.mkdir()
        run_in_process(scenario.model_dump(mode="json"), run_dir)
        return _counted(number, kind, run_dir)


def _counted(number: int, kind: str, run_dir: Path) -> HonestRow:
    with Run(run_dir) as run:
        roads = RegionMap.whole(run.setup.road_map)
        equipped = [row for row in run.rows(TruthRow) if row.equipment]
        low = {agent: found["frames_excluded"] for agent, found in agent_scores(run).items()}
        reasons = Counter[str]()
        for row in run.rows(DropRow):
            if row.reason.startswith(_EXCLUDED):
                reasons[row.reason] += row.times
    return HonestRow(
        run=number,
        net=kind,
        agents=len({row.vehicle for row in equipped}),
        agent_frames=len(equipped),
        beyond_map=sum(not roads.knows(row.x_m, row.y_m) for row in equipped),
        excluded_agents=sum(frames > 0 for frames in low.values()),
        excluded=int(sum(low.values())),
        reasons=dict(reasons),
    )


def print_honest(rows: list[HonestRow], console: Console) -> None:
    """Prints a line for each run, and their sum."""
    heads = ("net", "vehicles with radio", "their frames", "beyond the map", "excluded", "frames")
    table = empty_table(["run", *heads, "reasons"], left=2)
    for row in rows:
        table.add_row(
            str(row.run),
            row.net,
            str(row.agents),
            str(row.agent_frames),
            str(row.beyond_map),
            str(row.excluded_agents),
            str(row.excluded),
            ", ".join(f"{reason} {times}" for reason, times in row.reasons.items()),
        )
    print_whole(table, console)
    frames, excluded = sum(row.agent_frames for row in rows), sum(row.excluded for row in rows)
    console.print(f"{excluded} of {frames} frames of honest agents were excluded", highlight=False)


def measure_honest(seed: int, first: int, runs: int, keys: dict[str, Any]) -> Iterator[HonestRow]:
    """Yields the row of each run."""
    for number in range(first, first + runs):
        yield honest_run(seed, number, keys)


def main(
    *,
    runs: Annotated[int, typer.Option(min=1, help="how many")] = 20,
    first: Annotated[int, typer.Option(min=0, help="number of the first")] = 0,
    minutes: Annotated[float, typer.Option(min=0.1, max=60, help="of each")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="of nets and traffic")] = 1,
    overrides: Override = None,
    as_json: AsJson = False,
) -> None:
    """Count honest agents that the edge excludes, one frame a second, in the world `hard`."""
    try:
        keys = {
            "realism": "hard",
            "frame_period_s": 1,
            "duration_s": minutes * 60,
            "processes.vehicle": 1,
            "traffic.cv_rate": 0.05,
        } | assigned(overrides)
        show_measured(measure_honest(seed, first, runs, keys), runs, print_honest, as_json=as_json)
    except CpnetError as error:
        errors.print(f"[bold red]error[/] {escape(str(error))}", soft_wrap=True)
        raise typer.Exit(2) from None


if __name__ == "__main__":
    typer.run(main)
