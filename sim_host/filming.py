"""Traffic on the fixed plan, seen at chosen moments; no role takes part."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from protocol.messages import Setup
from sim_host.world import Bodies, Ground, World


def film(
    setup: Setup, run_dir: Path, ground: Ground, seed: int, steps: Sequence[int]
) -> list[Bodies]:
    """Returns the bodies after each of these numbers of SUMO steps, which must ascend.

    One such world at a time and process: libsumo keeps its state globally.

    Raises:
        ConfigError: SUMO refuses its files or gives up.
    """
    world = World(setup, run_dir, ground)
    moments = []
    done = 0
    try:
        world.start(seed)
        for wanted in steps:
            for _ in range(wanted - done):
                world.step()
            done = wanted
            moments.append(world.bodies())
    finally:
        world.close()
    return moments
