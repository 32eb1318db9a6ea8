"""The recorded world instead of SUMO, and the sim role around it; signals do not affect it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from protocol.errors import ConfigError
from protocol.messages import PARKED, Equipment, SignalState, Tick, TileBodies, Trip, Trips, Truth
from protocol.process import Context
from protocol.tiles import Tile, joined
from recording.config import ReplayConfig
from recording.mcap.reader import McapReader
from recording.playback.frames import FRAME_TOPIC, RecordedFrames
from sim_host.role import SimRole
from sim_host.setup import traffic_config
from sim_host.world import TrafficCounts, TrafficState

WORLD_TOPICS = ("tick", "bodies", "truth", "trips", FRAME_TOPIC)
_NOBODY = TrafficState(
    ids=[],
    types=[],
    lanes=[],
    poses=np.zeros((0, 6)),
    speeds_mps=np.zeros(0, np.float32),
    lane_positions_m=np.zeros(0, np.float32),
    equipment=np.zeros(0, np.uint8),
)


class RecordedWorld:
    """Plays a recorded frame in a number of steps; implements `sim_host.world.Traffic`.

    Frames have their recorded times. In a frame that the recording lacks, bodies do not move.
    """

    def __init__(self, frames: RecordedFrames, *, step_ns: int, steps: int, warmup_ns: int) -> None:
        """Goes back to before the first frame by the warm-up, which the signal goes through again.

        Raises:
            ConfigError: the recording has no frame.
        """
        first = frames.first("tick", FRAME_TOPIC)
        if first is None:
            raise ConfigError(
                "the recording holds no frame: neither a tick nor a state of the signal"
            )
        self._frames = frames
        self._step_ns, self._steps = step_ns, steps
        self._step = (
            -warmup_ns // step_ns
        )  # of the frame; before the first, in the warm-up: below 0
        self._bodies, self._ended = _NOBODY, list[Trip]()
        self._trips = list[Trip]()
        self._tiles: dict[Tile, TileBodies] = {}
        self._frame = self.first_frame = first
        self.time_ns = 0
        self._open()
        self.time_ns += self._step * step_ns
        self.counts = TrafficCounts(inserted=len(self._bodies.ids))

    def step(self) -> None:
        """Goes on by one step, with the last of a frame to the next."""
        self._step += 1
        self.time_ns += self._step_ns
        if self._step == self._steps:
            self._step = 0
            self._frame += 1
            self._ended = self._trips
            self._open()

    def bodies(self) -> TrafficState:
        """Returns where every vehicle was."""
        return self._bodies

    def set_signal(self, tls: str, state: str) -> None:
        """Does nothing: recorded traffic does not follow the signal."""

    def take_trips(self) -> list[Trip]:
        """Returns the journeys that ended in the frame that is over."""
        ended, self._ended = self._ended, []
        return ended

    def unfinished_trips(self) -> list[Trip]:
        """Returns nothing: unfinished journeys are in the recording, with its last frame."""
        return []

    def waiting(self) -> int:
        """Returns 0: no vehicle waits to enter."""
        return 0

    def close(self) -> None:
        """Holds nothing of its own."""

    def _open(self) -> None:
        messages = [item.message for item in self._frames.take(self._frame)]
        self._trips = [t for m in messages if isinstance(m, Trips) for t in m.trips]
        for message in messages:
            if isinstance(message, Tick | Truth | SignalState):
                self.time_ns = message.sim_time_ns
                break
        whole = [m for m in messages if isinstance(m, Truth)]
        ticks = [m for m in messages if isinstance(m, Tick)]
        self._tiles |= {(m.column, m.row): m for m in messages if isinstance(m, TileBodies)}
        if whole:
            self._bodies = TrafficState.of_truth(whole[0])
        elif ticks:
            tiles = [self._tiles.get((c, r)) for c, r in ticks[0].tiles.tolist()]
            self._bodies = _bodies_of_tiles(ticks[0], [one for one in tiles if one is not None])


def _bodies_of_tiles(tick: Tick, tiles: list[TileBodies]) -> TrafficState:
    """Returns the bodies of a recording without truth; their lanes are unknown.

    Parked cars are left out: they come with the setup.
    """
    found = joined(tiles)
    moving = [n for n, name in enumerate(found.ids) if not name.startswith(PARKED)]
    ids = [found.ids[n] for n in moving]
    carried = dict(zip(tick.agents, tick.equipment.tolist(), strict=True))
    return TrafficState(
        ids=ids,
        types=[found.types[n] for n in moving],
        lanes=[""] * len(ids),
        poses=found.poses[moving],
        speeds_mps=found.speeds_mps[moving],
        lane_positions_m=np.zeros(len(ids), np.float32),
        equipment=np.array([carried.get(name, Equipment.NONE) for name in ids], np.uint8),
    )


def sim_role(context: Context) -> SimRole:
    """Opens the recording that the scenario names and announces the role.

    Raises:
        ConfigError: the recording cannot be read, or holds no frame.
    """
    scenario = context.setup.scenario
    replay = ReplayConfig.model_validate(scenario["replay"])
    traffic = traffic_config(scenario)
    world = RecordedWorld(
        RecordedFrames(McapReader(Path(replay.recording)).messages(WORLD_TOPICS)),
        step_ns=round(traffic.step_s * 1e9),
        steps=max(1, round(scenario["frame_period_s"] / traffic.step_s)),
        warmup_ns=round(traffic.warmup_s * 1e9),
    )
    if replay.damaged:  # found before the start; only this process of all readers logs it
        context.inbox.drops["damaged_in_recording"] += replay.damaged
    role = SimRole(context, world, first_frame=world.first_frame, speed=replay.speed)
    return role.open()
