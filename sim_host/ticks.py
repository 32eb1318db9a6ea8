"""Ticks: publishes each frame's bodies by map tile, and which process plays which agents."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from protocol.bus import Bus
from protocol.messages import Equipment, Setup, Tick, TileBodies, TileRequest, is_bystander
from protocol.tiles import Tile, tile_name, tiles_of
from sim_host.presence import Fleet
from sim_host.world import TrafficState


class TickPublisher:
    """Publishes the tiles in which something changed, then the tick, on the world bus."""

    def __init__(self, bus: Bus, setup: Setup | None = None) -> None:
        """Publishes on the world bus; a setup's parked cars stand in every tick."""
        self._bus = bus
        self._setup = setup
        self._published: dict[Tile, TileBodies] = {}

    def publish(self, frame: int, sim_time_ns: int, bodies: TrafficState, fleet: Fleet) -> None:
        """Publishes a frame's bodies; vehicles without radio are assigned to no process."""
        if self._setup is not None:
            bodies = bodies.with_parked(self._setup)
        before, self._published = self._published, {}
        for tile, members in _by_tile(bodies).items():
            now = _tile_bodies(frame, tile, bodies, members)
            known = before.get(tile)
            if known is not None and _stand_still(known, now):
                self._published[tile] = known
                continue
            self._published[tile] = now
            self._bus.publish("bodies", now, tile=tile_name(tile))
        self._bus.publish("tick", self._tick(frame, sim_time_ns, bodies, fleet))

    def answer(self, request: TileRequest) -> None:
        """Publishes again the tiles that a process lacks; nothing for one without bodies."""
        for column, row in request.tiles.tolist():
            if (kept := self._published.get((column, row))) is not None:
                self._bus.publish("bodies", kept, tile=tile_name((column, row)))

    def _tick(self, frame: int, sim_time_ns: int, bodies: TrafficState, fleet: Fleet) -> Tick:
        radios = np.flatnonzero(bodies.equipment != Equipment.NONE)
        agents = [bodies.ids[n] for n in radios]
        kinds = map(Equipment, bodies.equipment[radios].tolist())
        hosts: Mapping[str, str] = fleet.assign(dict(zip(agents, kinds, strict=True)))
        number = {name: index for index, name in enumerate(fleet.processes)}
        return Tick(
            frame=frame,
            sim_time_ns=sim_time_ns,
            processes=fleet.processes,
            bodies=sum(not is_bystander(name) for name in bodies.ids),
            agents=agents,
            equipment=bodies.equipment[radios],
            hosts=np.array([number[hosts[n]] if n in hosts else -1 for n in agents], np.int32),
            places=bodies.poses[radios, :2],
            tiles=np.array(list(self._published), np.int32).reshape(-1, 2),
            since=np.array([one.frame for one in self._published.values()], np.int64),
        )


def _by_tile(bodies: TrafficState) -> dict[Tile, npt.NDArray[np.int64]]:
    """Returns the indices of the bodies of each tile that holds any, ascending."""
    if not bodies.ids:
        return {}
    tiles, of = np.unique(tiles_of(bodies.poses), axis=0, return_inverse=True)
    order = np.argsort(of.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(of.reshape(-1)))
    parts = np.split(order, ends[:-1])
    return {(int(c), int(r)): part for (c, r), part in zip(tiles, parts, strict=True)}


def _tile_bodies(
    frame: int, tile: Tile, bodies: TrafficState, members: npt.NDArray[np.int64]
) -> TileBodies:
    return TileBodies(
        frame=frame,
        column=tile[0],
        row=tile[1],
        ids=[bodies.ids[n] for n in members],
        types=[bodies.types[n] for n in members],
        poses=bodies.poses[members],
        speeds_mps=bodies.speeds_mps[members],
    )


def _stand_still(before: TileBodies, now: TileBodies) -> bool:
    return (
        before.ids == now.ids
        and np.array_equal(before.poses, now.poses)
        and np.array_equal(before.speeds_mps, now.speeds_mps)
    )
