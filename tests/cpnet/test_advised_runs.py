"""Speed advice in whole runs: vehicles follow it, and a run repeats row for row."""

from __future__ import annotations

import json
from pathlib import Path

from cpnet import scenario as scenarios
from recording.run import Run, differences
from recording.tables import TruthRow
from sim_host.world import World
from studies.in_process import run_in_process
from tests.cpnet.commands import rows

REPORTS_ALONE = (
    "--set=roadside_mounts=[]",
    "--set=traffic.cav_rate=0",
    "--set=traffic.cv_rate=0.5",
    "--set=frame_period_s=0.5",
)
"""Half of the vehicles report themselves and none has a LiDAR: that is quick."""


def speeds(folder: Path) -> dict[tuple[int, str], float]:
    with Run(folder) as run:
        return {(row.frame, row.vehicle): row.speed_mps for row in run.rows(TruthRow)}


def test_vehicles_follow_advice_and_the_rows_are_the_same_whatever_the_processes(
    shell, monkeypatch
) -> None:
    advising = ("--set=signal.policy=predictive", "--set=signal.speed_advice=true")
    status, output = shell.up("--duration=20", *REPORTS_ALONE, *advising, "--out=first").finish()
    assert status == 0, output
    first, alone = shell.folder / "first", shell.folder / "alone"
    obeyed: list[tuple[int, str, float]] = []
    set_speed = World.set_speed

    def note(world: World, agent: str, speed_mps: float | None) -> None:
        if speed_mps is not None:
            obeyed.append((world.time_ns, agent, speed_mps))
        set_speed(world, agent, speed_mps)

    monkeypatch.setattr(World, "set_speed", note)
    scenario = json.loads((first / "scenario.json").read_text())
    alone.mkdir()
    run_in_process(scenario, alone)
    assert differences(first, alone) == []
    assert rows(alone, "truth") > 0
    assert len({agent for _, agent, _ in obeyed}) > 3
    assert all(5 <= speed_mps <= 14 for _, _, speed_mps in obeyed)

    free = shell.folder / "free"
    free.mkdir()
    scenario["signal"]["speed_advice"] = False
    run_in_process(scenarios.validate(scenario, "free").model_dump(mode="json"), free)
    with_advice, without = speeds(alone), speeds(free)
    start_ns = round(scenario["traffic"]["warmup_s"] * 1e9)
    ns = round(scenario["frame_period_s"] * 1e9)
    at = [((time_ns - start_ns) // ns + 1, agent) for time_ns, agent, _ in obeyed]
    slower = [
        with_advice[one] < without[one] - 1 for one in at if one in with_advice and one in without
    ]
    assert sum(slower) > 5
    with Run(alone) as run:
        assert run.query("SELECT * FROM drops WHERE reason LIKE 'advice%'") == []
