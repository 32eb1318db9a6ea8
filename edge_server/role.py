"""The edge role: subscribes to scans and poses, publishes detections, lane counts and plans.

Input and output around the assembly of frames (`assembler`), the pipeline and the planner.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace

from edge_server.assembler import MAX_OPEN_FRAMES, Assembler
from edge_server.border import BorderExchange, BorderStrips
from edge_server.config import EdgeConfig
from edge_server.decoding import DecoderPool, PendingChunk
from edge_server.frame import AgentDetections, Chunk, Frame, FrameState
from edge_server.owners import AgentOwners
from edge_server.pipeline import Pipeline
from edge_server.planner import Planner
from edge_server.scenario import has_lidars, places_of, virtual_deadline
from edge_server.tracking import ShownSignals
from protocol.errors import CodecError
from protocol.inbox import Envelope, Presence
from protocol.instances import (
    AGENT_ROLES,
    instances_of,
    mounts_in,
    region_instances,
    region_of,
)
from protocol.messages import (
    AgentPose,
    Arrival,
    BorderObjects,
    Metrics,
    Objects,
    Roster,
    Scan,
    SignalState,
    Span,
)
from protocol.process import Context
from protocol.regions import regions_of
from sensing.config import SceneConfig
from sensing.terrain import believed_map

_TIMES_MAX_BYTES = 200 << 10  # of a frame's times in one message
_TIMES_BYTES = 200  # of one part, besides its agent's id, which stands there three times


class EdgeRole:
    """The edge role: threads decode and place chunks as they arrive.

    The thread of the loop does all else, once the frame is complete.
    """

    def __init__(self, context: Context) -> None:
        scenario = context.setup.scenario
        config = EdgeConfig.model_validate(scenario["edge"])
        self._context = context
        self._region = region_of(context.id)
        scene = SceneConfig.model_validate(scenario.get("scene", {}))
        road_map = believed_map(context.setup.road_map, scene, scenario["seed"])
        regions = regions_of(road_map, scenario)
        own = regions[self._region]
        strips = BorderStrips(own, regions) if len(regions) > 1 else None
        mounts = mounts_in(scenario, self._region)
        self._pipeline = Pipeline.of(
            own,
            config,
            seed=scenario["seed"],
            has_lidars=has_lidars(scenario, mounts),
            mounts=places_of(mounts, context.setup.road_map),
            strips=strips,
        )
        self._border = BorderExchange(strips) if strips is not None else None
        self._signals = ShownSignals()
        self._decoders = DecoderPool(self._pipeline.open, context.inbox.wake)
        agents = [one for one in instances_of(scenario) if one.role in AGENT_ROLES]
        expected = {one.id: one.role for one in agents if one.region in ("", self._region)}
        self._missing = set(expected)
        self._announced = False
        self._border_bytes = 0
        self._lockstep = scenario["mode"] == "lockstep"
        self._border_wait_ns = round(
            (config.lockstep_timeout_s if self._lockstep else config.border_wait_ms / 1000) * 1e9
        )
        wait_s = config.lockstep_timeout_s if self._lockstep else config.deadline_ms / 1000
        self._planner = Planner(scenario, config.plan, own.area)
        self._virtual_deadline = virtual_deadline(scenario, config)
        self._covers = self._planner.covers if self._planner.ends_early else None
        self._assembler = Assembler(
            wait_ns=round(wait_s * 1e9),
            expected=expected,
            covers=None if self._virtual_deadline else self._covers,
        )
        host = region_instances("infra", [self._region])[0].id
        self._owners = AgentOwners({one["id"]: host for one in mounts}, self._assembler.drops)

    @classmethod
    def build(cls, context: Context) -> EdgeRole:
        """Prepares the role and subscribes; it is announced once all agents are present."""
        role = cls(context)
        role.warm_up()
        context.inbox.limit("scan", MAX_OPEN_FRAMES)
        context.inbox.set_quotas(is_paced=not role._lockstep)
        for topic in ("roster", "pose", "scan", "objects"):
            context.v2x.subscribe(topic, region=role._region)
        for region in role._border.neighbours if role._border else ():
            context.v2x.subscribe("border", region=region)
        for tls in context.setup.scenario["regions"][role._region]:
            context.v2x.subscribe("state", tls=tls)  # for the time, too
        context.v2x.watch()
        return role

    def warm_up(self) -> None:
        """Runs the stages once, so that the first frame costs no more than the others."""
        self._pipeline.run(Frame(0, 0, [], [], [], complete=True, first_ns=0, ready_ns=0))

    def on(self, item: Envelope | Presence) -> None:
        """Handles a presence or a part of a frame; an undecodable scan counts as empty."""
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
            case BorderObjects() as found:
                if self._border is not None and not self._border.take(item.parts["region"], found):
                    self._assembler.drops["late_border"] += 1
            case SignalState() as state:
                self._assembler.add_time(state.frame, state.sim_time_ns)
                self._signals.note(state)

    def _is_its_own(self, item: Envelope) -> bool:
        """Whether a message's sender is that of its key, and its agent belongs to the sender.

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
        """Announces the process once it is due, and processes the next frame that is ready."""
        for pending in self._decoders.done():
            self._add(pending)
        if not self._announced and not self._missing:
            self._announced = True
            self._context.announce("edge")
        now_ns = time.monotonic_ns()
        self._assembler.wait_not_for(self._context.inbox.flooding(now_ns))
        if self._border is None or self._border.state is None:
            frame = self._assembler.pop(now_ns)
            if frame is not None:
                self._begin(frame)
        if self._border is not None and self._border.is_due(now_ns):
            self._finish(self._border.end())

    def _begin(self, frame: Frame) -> None:
        """Runs a frame's stages; up to its end where there are no neighbours."""
        cut = self._cut(frame)
        cut = replace(
            cut, signals=self._signals.before(frame.frame), cells=self._planner.cells_of(cut)
        )
        self._publish_plans(frame, cut)
        state = self._pipeline.begin(cut)
        self._assembler.drops.update(state.excluded)
        if self._border is None:
            self._finish(state)
        else:
            message = self._border.begin(state, self._border_wait_ns)
            sent_bytes = self._context.v2x.publish("border", message, region=self._region)
            self._border_bytes = sent_bytes * len(self._border.neighbours)

    def _finish(self, state: FrameState) -> None:
        """Runs the stages after the exchange with neighbours, and publishes."""
        self._pipeline.finish(state)
        self._assembler.drops.update(+state.drops)
        self._publish(state)

    def close(self) -> None:
        """Ends the threads."""
        self._decoders.close()

    def _hear(self, presence: Presence) -> None:
        if presence.role == "edge" and self._border is not None:
            self._border.note_edge(region_of(presence.id), alive=presence.alive)
        if presence.role in AGENT_ROLES:
            self._missing.discard(presence.id)
            if not presence.alive:
                self._owners.forget(presence.id)
            self._assembler.hear(presence.id, presence.role, alive=presence.alive)

    def _cut(self, frame: Frame) -> Frame:
        """Excludes, over virtual links, what has not arrived in simulated time."""
        if self._virtual_deadline is None:
            return frame
        cut, late = self._virtual_deadline.cut(frame, self._covers)
        self._assembler.drops["late"] += late
        return cut

    def _note_site(self, message: AgentPose | Scan) -> None:
        if self._assembler.admits(message.frame):
            self._planner.sites.add(message)

    def _take_scan(self, scan: Scan, came: Envelope) -> None:
        """Decodes what is wanted. A late scan still yields its agent's place and uplink rate."""
        self._note_site(scan)
        if not self._lockstep:
            self._planner.bandwidth.add(
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
        """Takes a chunk from the decoder pool; counts one that could not be decoded."""
        scan = pending.scan
        try:
            chunk = pending.chunk()
        except CodecError as error:
            self._context.inbox.refuse("scan", error, f"scan of {scan.agent}")
            chunk = Chunk.undecodable(scan, pending.received_ns)
        except (ValueError, LookupError, TypeError) as error:
            self._context.inbox.fail("scan", error)
            self._assembler.forgo(scan)
            return
        self._assembler.add_chunk(chunk)

    def _publish_plans(self, frame: Frame, cut: Frame) -> None:
        """Publishes plans before the frame is processed: agents learn that the frame is over.

        In lockstep an agent waits for it before it begins the next frame.
        """
        enough_sim_ns = self._virtual_deadline.end_ns(cut) if self._virtual_deadline else None
        for plan in self._planner.plans(frame, enough_sim_ns):
            self._context.v2x.publish("plan", plan, region=self._region, agent=plan.agent)

    def _publish(self, state: FrameState) -> None:
        bus, frame = self._context.v2x, state.frame
        for tls, counts in state.counts.items():
            bus.publish("lanes", counts, region=self._region, tls=tls)
        bus.publish("detections", state.detections, region=self._region)
        published = _within_message(frame)
        self._assembler.drops["untold"] += len(frame.chunks) - len(published.chunks)
        metrics = Metrics(
            process=self._context.id,
            frame=frame.frame,
            sim_time_ns=frame.sim_time_ns,
            spans=_waits(published) + state.spans,
            arrivals=_arrivals(published),
            points=state.points,
            scores=state.scores,
            alignments=state.alignments,
            border_bytes=self._border_bytes,
            drops=dict(+(Counter(self._context.inbox.drops) + self._assembler.drops)),
        )
        self._context.world.publish("metrics", metrics, process=self._context.id)


def _within_message(frame: Frame) -> Frame:
    """Returns the frame with as many of its parts as fit into one message."""
    left = _TIMES_MAX_BYTES
    chunks, found = list[Chunk](), list[AgentDetections]()
    for chunk in frame.chunks:
        left -= _TIMES_BYTES + 3 * len(chunk.agent.encode())
        chunks += [chunk] if left >= 0 else []
    for one in frame.found:
        left -= _TIMES_BYTES + 3 * len(one.agent.encode())
        found += [one] if left >= 0 else []
    return replace(frame, chunks=chunks, found=found)


def _arrivals(frame: Frame) -> list[Arrival]:
    chunks = [(p.agent, p.index, p.received_ns, p.decoded_ns) for p in frame.chunks]
    boxes = [(one.agent, 0, one.received_ns, one.received_ns) for one in frame.found]
    return [
        Arrival(agent=agent, chunk=chunk, received_ns=received_ns, decoded_ns=decoded_ns)
        for agent, chunk, received_ns, decoded_ns in chunks + boxes
    ]


def _waits(frame: Frame) -> list[Span]:
    """Returns the waiting time of the frame, and the stages of its chunks, as spans."""
    wait = Span(stage="wait", start_ns=frame.first_ns, end_ns=frame.ready_ns)
    return [wait, *(span for chunk in frame.chunks for span in chunk.spans)]
