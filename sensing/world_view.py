"""World view of an agent process: the bodies around its agents in a frame, by map tiles."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.messages import Equipment, Tick, TileBodies, TileRequest
from protocol.tiles import Tile, joined, tile_name, tiles_within
from sensing.pose import driven

AHEAD_M = 50.0
"""Margin, m: tiles are subscribed to this much before an agent needs them, kept for twice that."""
_ASK_AGAIN_NS = 200_000_000


@dataclass(frozen=True, slots=True, eq=False)
class WorldView:
    """A frame as an agent process sees it.

    Attributes:
        frame: its number.
        sim_time_ns: when it begins.
        ids: the bodies around its agents (N,), sorted.
        types: their types (N,).
        poses: (N, 6) of their footprints' centres on the ground, map frame.
        speeds_mps: (N,).
        hosted: the CAVs and CVs that this process plays, by index into `ids`, ascending.
    """

    frame: int
    sim_time_ns: int
    ids: list[str]
    types: list[str]
    poses: Floats
    speeds_mps: npt.NDArray[np.float32]
    hosted: dict[int, Equipment]

    def later(self, by_s: float) -> WorldView:
        """Returns the view with all bodies a little later, or earlier, each straight ahead.

        To first order: nothing turns or changes its speed within the few ms of a clock's error.
        Frame and time stay those that the agent assumes.
        """
        if by_s == 0.0:
            return self
        ahead_m = self.speeds_mps.astype(np.float64) * by_s
        return replace(self, poses=driven(self.poses, ahead_m))

    @classmethod
    def without_bodies(cls, tick: Tick) -> WorldView:
        """Returns a frame's view of a process that needs no bodies."""
        nothing = np.zeros((0, 6)), np.zeros(0, np.float32)
        return cls(tick.frame, tick.sim_time_ns, [], [], *nothing, {})


class Surroundings:
    """Follows the tiles that the LiDARs of a process reach, as its agents drive and change.

    A tile that a process did not subscribe to in time, or whose message was lost, is requested.
    """

    def __init__(self, bus: Bus, process: str, reach_m: float) -> None:
        """Takes the world bus, the process's id and how far its agents see."""
        self._bus = bus
        self._process = process
        self._reach_m = reach_m
        self._fixed = np.zeros((0, 2))
        self._followed: set[Tile] = set()
        self._known: dict[Tile, TileBodies] = {}
        self._needed: dict[Tile, int] = {}
        self._hosted: dict[str, Equipment] = {}
        self._asked_ns = 0

    def stand_at(self, places: Floats) -> None:
        """Follows the tiles around sensors that stand at x, y (N, 2) for good."""
        self._fixed = places
        self._follow(places)

    def take(self, bodies: TileBodies) -> None:
        """Takes a tile, unless a newer one is known."""
        tile = bodies.column, bodies.row
        known = self._known.get(tile)
        if tile in self._followed and (known is None or bodies.frame >= known.frame):
            self._known[tile] = bodies

    def begin(self, tick: Tick) -> None:
        """Begins a frame: the needed tiles follow from where the process's agents are."""
        mine = np.zeros(0, np.int64)
        if self._process in tick.processes:
            mine = np.flatnonzero(tick.hosts == tick.processes.index(self._process))
        self._hosted = {tick.agents[n]: Equipment(int(tick.equipment[n])) for n in mine}
        places = np.concatenate([self._fixed, tick.places[mine]])
        self._follow(places)
        near = tiles_within(places, self._reach_m)
        tiles = zip(map(tuple, tick.tiles.tolist()), tick.since.tolist(), strict=True)
        self._needed = {tile: since for tile, since in tiles if tile in near}
        self._asked_ns = 0

    def is_complete(self) -> bool:
        """Whether all tiles of the frame have arrived; requests missing ones repeatedly."""
        missing = [tile for tile, since in self._needed.items() if not self._has(tile, since)]
        now_ns = time.monotonic_ns()
        if missing and now_ns - self._asked_ns > _ASK_AGAIN_NS:
            self._asked_ns = now_ns
            request = TileRequest(tiles=np.array(missing, np.int32))
            self._bus.publish("tiles", request, process=self._process)
        return not missing

    def view(self, tick: Tick) -> WorldView:
        """Returns the frame's bodies."""
        near = joined(self._known[tile] for tile in self._needed)
        hosted = {n: self._hosted[name] for n, name in enumerate(near.ids) if name in self._hosted}
        return WorldView(
            tick.frame,
            tick.sim_time_ns,
            near.ids,
            near.types,
            near.poses,
            near.speeds_mps,
            hosted,
        )

    def _has(self, tile: Tile, since: int) -> bool:
        known = self._known.get(tile)
        return known is not None and known.frame >= since

    def _follow(self, places: Floats) -> None:
        """Subscribes to tiles that come near, and leaves those that are far."""
        for tile in sorted(tiles_within(places, self._reach_m + AHEAD_M) - self._followed):
            self._bus.subscribe("bodies", tile=tile_name(tile))
            self._followed.add(tile)
        for tile in sorted(self._followed - tiles_within(places, self._reach_m + 2 * AHEAD_M)):
            self._bus.unsubscribe("bodies", tile=tile_name(tile))
            self._followed.discard(tile)
            self._known.pop(tile, None)
