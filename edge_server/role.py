"""What becomes of memory that a frame no longer needs."""

from __future__ import annotations

import ctypes
import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from edge_server.assembler import MAX_OPEN_FRAMES, Assembler
from edge_server.completion import VirtualDeadline
from edge_server.config import EdgeConfig
from edge_server.decoding import DecoderPool, PendingChunk
from edge_server.frame import AgentDetections, Chunk, Frame, undecodable_scan
from edge_server.owners import AgentOwners
from edge_server.pipeline import Pipeline, Result
from edge_server.planner import Planner
from perception.arrays import Floats
from protocol.errors import CodecError
from protocol.inbox import Envelope, Presence
from protocol.messages import (
    AgentPose,
    Arrival,
    Metrics,
    Objects,
    Roster,
    Scan,
    SignalState,
    Span,
)
from protocol.process import Context
from protocol.roadmap import RoadMap
from sensing.config import Mount, UploadConfig
from sensing.link_config import LinkConfig
from sensing.upload_policies import policy_of

# Of malloc.h: the free memory on top of the heap that goes back to the kernel, the size of what
# gets pages of its own, and how many heaps there may be.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_LARGEST_BYTES = 32 << 20  # glibc takes no more
_KEPT_BYTES = 512 << 20


def keep_freed_memory() -> None:
    """Has the process keep what it frees, for the next frame, whichever thread works on it.

    A frame's arrays are large enough for glibc to give them back each time; to be given the same
    pages anew, zeroed, can take a fourth of a frame's time. Other C libraries are left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGEST_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
        mallopt(_ARENA_MAX, 1)


_TOLD_BYTES = 200 << 10  # of a frame's times in one message
_TIMES_BYTES = 200  # of one part, besides its agent's id, which stands there three times


class EdgeRole:
    """Scans are decoded and placed as they come, by threads, while others are under way.

    All else is done by the thread of the loop, once the frame is whole.
    """

    def __init__(self, context: Context) -> None:
        scenario = context.setup.scenario
        config = EdgeConfig.model_validate(scenario["edge"])
        self._context = context
        self._region: str = scenario["region"]
        self._tls = context.setup.road_map.signal.tls
        road_map = context.setup.road_map
        self._pipeline = Pipeline(
            road_map,
            config,
            seed=scenario["seed"],
            has_lidars=has_lidars(scenario),
            posts=mounts_of(scenario, road_map),
        )
        self._decoders = DecoderPool(self._pipeline.open, context.inbox.wake)
        expected = expected_agents(scenario)
        self._missing = set(expected)
        self._announced = False
        self._lockstep = scenario["mode"] == "lockstep"
        wait_s = config.lockstep_timeout_s if self._lockstep else config.deadline_ms / 1000
        self._planner = Planner(scenario, config.plan, context.setup.road_map)
        self._punctuality = punctuality(scenario, config)
        self._covers = self._planner.covers if self._planner.ends_early else None
        self._assembler = Assembler(
            wait_ns=round(wait_s * 1e9),
            expected=expected,
            covers=None if self._punctuality else self._covers,
        )
        mounts = scenario["roadside_mounts"]
        posts = {mount["id"]: f"infra-{n}" for n, mount in enumerate(mounts)}
        self._owners = AgentOwners(posts, self._assembler.drops)

    @classmethod
    def build(cls, context: Context) -> EdgeRole:
        """Makes the role ready and listens; it shows itself once all agents are there."""
        role = cls(context)
        role.warm_up()
        context.inbox.limit("scan", MAX_OPEN_FRAMES)
        context.inbox.set_quotas(is_paced=not role._lockstep)
        for topic in ("roster", "pose", "scan", "objects"):
            context.v2x.subscribe(topic, region=role._region)
        context.v2x.subscribe("state", tls=role._tls)
        context.v2x.watch()
        return role

    def warm_up(self) -> None:
        """Runs the stages once, so that the first frame costs no more than the others."""
        self._pipeline.run(Frame(0, 0, [], [], [], complete=True, first_ns=0, ready_ns=0))

    def on(self, item: Envelope | Presence) -> None:
        """Takes a presence or a part of a frame; a scan that does not decode counts as empty."""
        if isinstance(item, Presence):
            self._hear(item)
            return
        if not self._is_its_own(item):
            return
        match item.message:
            case Roster() as roster:
                self._assembler.add_roster(self._owners.own(roster), item.received_ns)
            case AgentPose() as pose:
                self._note_site(pose)
                self._assembler.add_pose(pose, item.received_ns)
            case Scan() as scan:
                self._take_scan(scan, item)
            case Objects() as objects:
                self._assembler.add_objects(objects, item.received_ns)
            case SignalState() as state:
                self._assembler.add_time(state.frame, state.sim_time_ns)

    def _is_its_own(self, item: Envelope) -> bool:
        """Whether a message says of its sender what its key does, of an agent that is the sender's.

        With access control, a process can publish under its own id alone.
        """
        header = item.message
        if any(str(getattr(header, name, part)) != part for name, part in item.parts.items()):
            self._assembler.drops["wrong_sender"] += 1
            return False
        agent, process = item.parts.get("agent"), item.parts.get("process", "")
        if agent is None:
            return True
        if not self._assembler.is_there(process):
            self._assembler.drops["absent_process"] += 1
            return False
        return self._owners.admits(process, agent)

    def poll(self) -> None:
        """Shows the process once it is due, and works on the next frame that is ready."""
        for pending in self._decoders.done():
            self._add(pending)
        if not self._announced and not self._missing:
            self._announced = True
            self._context.announce("edge")
        now_ns = time.monotonic_ns()
        self._assembler.wait_not_for(self._context.inbox.flooding(now_ns))
        frame = self._assembler.pop(now_ns)
        if frame is not None:
            cut = self._cut(frame)
            self._publish_plans(frame, cut)
            result = self._pipeline.run(cut)
            self._assembler.drops.update(result.left_out)
            self._publish(cut, result)

    def close(self) -> None:
        """Ends the threads."""
        self._decoders.close()

    def _hear(self, presence: Presence) -> None:
        if presence.role in ("vehicle", "infra"):
            self._missing.discard(presence.id)
            if not presence.alive:
                self._owners.forget(presence.id)
            self._assembler.hear(presence.id, presence.role, alive=presence.alive)

    def _cut(self, frame: Frame) -> Frame:
        """Leaves out, over virtual links, what has not arrived in simulated time."""
        if self._punctuality is None:
            return frame
        cut, late = self._punctuality.cut(frame, self._covers)
        self._assembler.drops["late"] += late
        return cut

    def _note_site(self, message: AgentPose | Scan) -> None:
        if self._assembler.admits(message.frame):
            self._planner.sites.hear(message)

    def _take_scan(self, scan: Scan, came: Envelope) -> None:
        """Has opened what is wanted. What is late still tells of its agent's place and uplink."""
        self._note_site(scan)
        if not self._lockstep:
            self._planner.bandwidth.heard(
                scan.agent,
                scan.frame,
                len(came.data),
                sent_ns=scan.encode_end_ns,
                received_ns=came.received_ns,
            )
        if self._assembler.wants(scan, came.received_ns):
            self._assembler.begin(scan)
            for pending in self._decoders.put(scan, came.received_ns):
                self._add(pending)

    def _add(self, pending: PendingChunk) -> None:
        """Takes a scan that is open; counts one that could not be opened."""
        scan = pending.scan
        try:
            chunk = pending.chunk()
        except CodecError as error:
            self._context.inbox.refuse("scan", error, f"scan of {scan.agent}")
            chunk = undecodable_scan(scan, pending.received_ns)
        except (ValueError, LookupError, TypeError) as error:
            self._context.inbox.fail("scan", error)
            self._assembler.forgo(scan)
            return
        self._assembler.add_chunk(chunk)

    def _publish_plans(self, frame: Frame, cut: Frame) -> None:
        """Goes first, before the frame is worked on: it tells agents that the frame is over.

        In lockstep an agent waits for it before it begins the next frame.
        """
        enough_sim_ns = self._punctuality.end_ns(cut) if self._punctuality else None
        for plan in self._planner.plans(frame, enough_sim_ns):
            self._context.v2x.publish("plan", plan, region=self._region, agent=plan.agent)

    def _publish(self, frame: Frame, result: Result) -> None:
        bus = self._context.v2x
        bus.publish("lanes", result.counts, region=self._region, tls=self._tls)
        bus.publish("detections", result.detections, region=self._region)
        told = _told(frame)
        self._assembler.drops["untold"] += len(frame.chunks) - len(told.chunks)
        metrics = Metrics(
            process=self._context.id,
            frame=frame.frame,
            sim_time_ns=frame.sim_time_ns,
            spans=_waits(told) + result.spans,
            arrivals=_arrivals(told),
            points=result.points,
            doubts=result.doubts,
            drops=dict(+(Counter(self._context.inbox.drops) + self._assembler.drops)),
        )
        self._context.world.publish("metrics", metrics, process=self._context.id)


def expected_agents(scenario: dict[str, Any]) -> dict[str, str]:
    """Returns the agent processes that a scenario starts with, and their roles."""
    vehicles = scenario["processes"]["vehicle"]
    posts = len(scenario["roadside_mounts"])
    return {f"vehicle-{n}": "vehicle" for n in range(vehicles)} | {
        f"infra-{n}": "infra" for n in range(posts)
    }


def has_lidars(scenario: dict[str, Any]) -> bool:
    """Whether agents with a LiDAR belong to a scenario, be they there yet, that send what they see.

    The scenario says so, not what came: what never arrives must not pass for what does not exist.
    """
    upload = UploadConfig.model_validate(scenario.get("upload", {}))
    is_there = {
        "roadside": bool(scenario["roadside_mounts"]),
        "vehicle": bool(scenario.get("recording")) or scenario["traffic"]["cav_rate"] > 0,
    }
    return any(
        is_there[kind] and policy_of(upload.of(kind).policy).sends != "nothing"
        for kind in ("roadside", "vehicle")
    )


def mounts_of(scenario: dict[str, Any], road_map: RoadMap) -> dict[str, Floats]:
    """Returns by agent x, y and yaw (3,) of the posts in the scenario, in the map frame."""
    mounts = [Mount.model_validate(mount) for mount in scenario["roadside_mounts"]]
    x_m, y_m = road_map.centre[:2]
    return {m.id: np.array([x_m + m.x_m, y_m + m.y_m, np.radians(m.yaw_deg)]) for m in mounts}


def punctuality(scenario: dict[str, Any], config: EdgeConfig) -> VirtualDeadline | None:
    """Returns the rule by which virtual links drop what is late; None where links are real."""
    link = LinkConfig.of(scenario)
    if link.channel(scenario["mode"]) != "virtual":
        return None
    return VirtualDeadline(round(config.deadline_ms * 1e6), round(link.edge_compute_ms * 1e6))


def _told(frame: Frame) -> Frame:
    """Returns the frame with so many of its parts as have room in one message."""
    left = _TOLD_BYTES
    chunks, found = list[Chunk](), list[AgentDetections]()
    for chunk in frame.chunks:
        left -= _TIMES_BYTES + 3 * len(chunk.agent.encode())
        chunks += [chunk] if left >= 0 else []
    for one in frame.found:
        left -= _TIMES_BYTES + 3 * len(one.agent.encode())
        found += [one] if left >= 0 else []
    return replace(frame, chunks=chunks, found=found)


def _arrivals(frame: Frame) -> list[Arrival]:
    chunks = [(p.agent, p.index, p.received_ns, p.decode_end_ns) for p in frame.chunks]
    boxes = [(one.agent, 0, one.received_ns, one.received_ns) for one in frame.found]
    return [
        Arrival(agent=agent, chunk=chunk, received_ns=received_ns, decoded_ns=decoded_ns)
        for agent, chunk, received_ns, decoded_ns in chunks + boxes
    ]


def _waits(frame: Frame) -> list[Span]:
    spans = [Span(stage="wait", start_ns=frame.first_ns, end_ns=frame.ready_ns)]
    for chunk in frame.chunks:
        done_ns, agent = chunk.decode_end_ns, chunk.agent
        spans.append(
            Span(stage="decode", agent=agent, start_ns=chunk.decode_start_ns, end_ns=done_ns)
        )
        if chunk.placed is not None:
            spans.append(Span(stage="place", agent=agent, start_ns=done_ns, end_ns=chunk.placed_ns))
    return spans
