"""The edge role: hears scans and poses, says detections and lane counts."""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

from edge_server.assembler import MAX_OPEN_FRAMES, Assembler
from edge_server.config import EdgeConfig
from edge_server.frame import Frame, spoilt_scan
from edge_server.opening import Opener, Opening
from edge_server.pipeline import Pipeline, Result
from edge_server.planner import Planner
from edge_server.punctual import Punctuality
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
from sensing.link.config import LinkConfig


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
        self._pipeline = Pipeline(context.setup.road_map, config, seed=scenario["seed"])
        self._opener = Opener(self._pipeline.open, context.inbox.wake)
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

    @classmethod
    def build(cls, context: Context) -> EdgeRole:
        """Makes the role ready and listens; it shows itself once all agents are there."""
        role = cls(context)
        role.warm_up()
        context.inbox.limit("scan", MAX_OPEN_FRAMES)
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
        if not _is_its_own(item):
            self._assembler.drops["wrong_sender"] += 1
            return
        match item.message:
            case Roster() as roster:
                self._assembler.add_roster(roster, item.received_ns)
            case AgentPose() as pose:
                self._note_site(pose)
                self._assembler.add_pose(pose, item.received_ns)
            case Scan() as scan:
                self._take_scan(scan, item)
            case Objects() as objects:
                self._assembler.add_objects(objects, item.received_ns)
            case SignalState() as state:
                self._assembler.add_time(state.frame, state.sim_time_ns)

    def poll(self) -> None:
        """Shows the process once it is due, and works on the next frame that is ready."""
        for opening in self._opener.done():
            self._add(opening)
        if not self._announced and not self._missing:
            self._announced = True
            self._context.announce("edge")
        frame = self._assembler.pop(time.monotonic_ns())
        if frame is not None:
            cut = self._cut(frame)
            self._publish_plans(frame, cut)
            self._publish(cut, self._pipeline.run(cut))

    def close(self) -> None:
        """Ends the threads."""
        self._opener.close()

    def _hear(self, presence: Presence) -> None:
        if presence.role in ("vehicle", "infra"):
            self._missing.discard(presence.id)
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
                came.size_bytes,
                sent_ns=scan.encode_end_ns,
                received_ns=came.received_ns,
            )
        if self._assembler.wants(scan, came.received_ns):
            self._assembler.begin(scan)
            for opening in self._opener.put(scan, came.received_ns):
                self._add(opening)

    def _add(self, opening: Opening) -> None:
        """Takes a scan that is open; counts one that could not be opened."""
        scan = opening.scan
        try:
            piece = opening.piece()
        except CodecError as error:
            self._context.inbox.refuse(f"scan of {scan.agent}", error)
            piece = spoilt_scan(scan, opening.received_ns)
        except (ValueError, LookupError, TypeError) as error:
            self._context.inbox.fail("scan", error)
            self._assembler.forgo(scan)
            return
        self._assembler.add_piece(piece)

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
        metrics = Metrics(
            process=self._context.id,
            frame=frame.frame,
            sim_time_ns=frame.sim_time_ns,
            spans=_waits(frame) + result.spans,
            arrivals=_arrivals(frame),
            points=result.points,
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


def _is_its_own(item: Envelope) -> bool:
    """Whether a message says of its sender what the key does on which it came."""
    header = item.message
    return all(str(getattr(header, name, part)) == part for name, part in item.parts.items())


def punctuality(scenario: dict[str, Any], config: EdgeConfig) -> Punctuality | None:
    """Returns the rule by which virtual links drop what is late; None where links are real."""
    link = LinkConfig.of(scenario)
    if link.way(scenario["mode"]) != "virtual":
        return None
    return Punctuality(round(config.deadline_ms * 1e6), round(link.edge_compute_ms * 1e6))


def _arrivals(frame: Frame) -> list[Arrival]:
    chunks = [(p.agent, p.chunk, p.received_ns, p.decode_end_ns) for p in frame.pieces]
    boxes = [(one.agent, 0, one.received_ns, one.received_ns) for one in frame.found]
    return [
        Arrival(agent=agent, chunk=chunk, received_ns=received_ns, decoded_ns=decoded_ns)
        for agent, chunk, received_ns, decoded_ns in chunks + boxes
    ]


def _waits(frame: Frame) -> list[Span]:
    spans = [Span(stage="wait", start_ns=frame.first_ns, end_ns=frame.ready_ns)]
    for piece in frame.pieces:
        done_ns, agent = piece.decode_end_ns, piece.agent
        spans.append(
            Span(stage="decode", agent=agent, start_ns=piece.decode_start_ns, end_ns=done_ns)
        )
        if piece.placed is not None:
            spans.append(Span(stage="place", agent=agent, start_ns=done_ns, end_ns=piece.placed_ns))
    return spans
