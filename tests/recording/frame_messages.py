"""Messages of short recordings."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np

from cpnet import scenario as scenarios
from protocol import messages as m
from protocol.in_process import InProcessRouter
from protocol.inbox import Envelope, Inbox
from protocol.process import Context
from protocol.tiles import tile_name
from protocol.topics import BusName
from protocol.wire import encode
from recording.playback.frames import RecordedFrames
from recording.playback.role import PlayerRole
from sim_host.setup import resolved
from tests.messages import tick_of
from tests.roads import no_road

PERIOD_NS = 100_000_000
REGION = "r0"


def item(topic: str, message: m.Message, **parts: str) -> Envelope:
    return Envelope(topic, parts, message, 0, encode(message))


def state(frame: int, sim_time_ns: int | None = None) -> Envelope:
    at_ns = frame * PERIOD_NS if sim_time_ns is None else sim_time_ns
    shown = m.SignalState(
        frame=frame,
        sim_time_ns=at_ns,
        tls="J",
        state="",
        stage="",
        green="",
        source="",
        earliest_change_ns=at_ns,
    )
    return item("state", shown, tls="J")


def tick(
    frame: int, sim_time_ns: int | None = None, tiles: tuple[tuple[int, int], ...] = ()
) -> Envelope:
    at_ns = frame * PERIOD_NS if sim_time_ns is None else sim_time_ns
    cells, since = np.array(tiles, np.int32).reshape(-1, 2), np.full(len(tiles), frame)
    return item("tick", tick_of(frame, at_ns, processes=["vehicle-0"], tiles=cells, since=since))


def bodies(frame: int, tile: tuple[int, int], *ids: str) -> Envelope:
    count = len(ids)
    stand = m.TileBodies(
        frame=frame,
        column=tile[0],
        row=tile[1],
        ids=[*ids],
        types=["car"] * count,
        poses=np.zeros((count, 6)),
        speeds_mps=np.zeros(count, np.float32),
    )
    return item("bodies", stand, tile=tile_name(tile))


def roster(frame: int, agents: list[str], process: str = "vehicle-0") -> Envelope:
    recorded = m.Roster(frame=frame, process=process, agents=agents, scanning=agents)
    return item("roster", recorded, region=REGION, process=process)


def pose(frame: int, agent: str, process: str = "vehicle-0", *, cav: bool = True) -> Envelope:
    recorded = m.AgentPose(
        frame=frame,
        sim_time_ns=frame * PERIOD_NS,
        agent=agent,
        equipment=m.Equipment.CAV if cav else m.Equipment.CV,
        pose=np.zeros(6),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=0.1,
        arrival_sim_ns=7,
    )
    return item("pose", recorded, region=REGION, process=process, agent=agent)


def scan(
    frame: int,
    agent: str,
    chunk: int = 0,
    chunks: int = 1,
    process: str = "vehicle-0",
    size: int = 9,
) -> Envelope:
    begun_ns = 1_000_000_000 + frame * PERIOD_NS
    recorded = m.Scan(
        frame=frame,
        sim_time_ns=frame * PERIOD_NS,
        agent=agent,
        chunk=chunk,
        chunks=chunks,
        points=3,
        plan_frame=max(frame - 2, -1),
        sensor_pose=np.arange(6.0),
        sense_start_ns=begun_ns,
        sense_end_ns=begun_ns + 2_000_000,
        encode_end_ns=begun_ns + 5_000_000 + chunk * 1_000_000,
        arrival_sim_ns=7,
        payload=np.full(size, (100 * chunk + frame) % 256, np.uint8),
    )
    where = {"region": REGION, "process": process, "agent": agent}
    return item("scan", recorded, **where, chunk=str(chunk))


ROADS = no_road("J", [(9, "G")])


class Rig:
    """A player role and its subscribers, on in-process buses."""

    def __init__(self, recorded: list[Envelope], process: str = "vehicle-0", **more: Any) -> None:
        data = scenarios.load("t_junction", {"replay": {"recording": "none"}, **more})
        setup = m.Setup(
            scenario=resolved(data.model_dump(mode="json"), ROADS),
            road_map=ROADS,
            vehicle_types=[],
            meshes=[],
            mesh_vertices=np.zeros((0, 3), np.float32),
            mesh_triangles=np.zeros((0, 3), np.int32),
        )
        self.v2x, self.world = InProcessRouter(), InProcessRouter(BusName.WORLD)
        self.inbox, self.received = Inbox(), Inbox()
        self.v2x_client = self.v2x.bus(self.received)
        self.world_client = self.world.bus(self.received)
        for topic in ("roster", "pose", "scan", "objects"):
            self.v2x_client.subscribe(topic)
        for topic in ("metrics", "sighting"):
            self.world_client.subscribe(topic)
        context = Context(
            process,
            setup,
            Path(),
            self.world.bus(self.inbox),
            self.v2x.bus(self.inbox),
            self.inbox,
            threading.Event(),
            lambda: self.v2x.bus(self.inbox),
        )
        self.role = PlayerRole(context, RecordedFrames(recorded))

    def play(self, frame: int) -> list[Envelope]:
        """Lets the world tick; returns what the player publishes."""
        recorded = tick(frame)
        assert isinstance(recorded.message, m.Tick)
        self.world_client.publish("tick", recorded.message)
        return self.turn()

    def turn(self) -> list[Envelope]:
        while (come := self.inbox.get()) is not None:
            self.role.on(come)
        self.role.poll()
        return self.published()

    def published(self) -> list[Envelope]:
        recorded = []
        while isinstance(come := self.received.get(), Envelope):
            recorded.append(come)
        return recorded


def of(kind: type[Any], recorded: list[Envelope]) -> list[Any]:
    return [one.message for one in recorded if isinstance(one.message, kind)]
