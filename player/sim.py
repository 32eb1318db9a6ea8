"""The sim role of a replay: the cabinet and the clock as ever, the world from the tape."""

from __future__ import annotations

from pathlib import Path

from player.config import ReplayConfig
from player.frames import Frames
from player.world import WORLD_TOPICS, TapeWorld
from protocol.process import Context
from sim_host.role import SimRole
from sim_host.setup import traffic_config
from tape.reader import Tape


def sim_role(context: Context) -> SimRole:
    """Opens the tape that the scenario names and announces the role.

    Raises:
        ConfigError: the tape cannot be read, or holds no frame.
    """
    scenario = context.setup.scenario
    replay = ReplayConfig.model_validate(scenario["replay"])
    traffic = traffic_config(scenario)
    world = TapeWorld(
        Frames(Tape(Path(replay.tape)).heard(WORLD_TOPICS)),
        step_ns=round(traffic.step_s * 1e9),
        steps=max(1, round(scenario["frame_period_s"] / traffic.step_s)),
        warmup_ns=round(traffic.warmup_s * 1e9),
    )
    if replay.damaged:  # found before the start; of all who read the tape, this one tells
        context.inbox.drops["damaged_on_tape"] += replay.damaged
    role = SimRole(context, world, first_frame=world.first_frame, speed=replay.speed)
    return role.open()
