"""The record role: subscribes to both buses and writes one database."""

from __future__ import annotations

import json
import logging
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import islice
from typing import Any

from protocol import messages as m
from protocol.errors import CpnetError, MessageError
from protocol.inbox import Envelope, Presence
from protocol.instances import region_instances
from protocol.messages import (
    Equipment,
    JunctionProgress,
    Metrics,
    Progress,
    RegionProgress,
    Tick,
)
from protocol.process import Context
from protocol.topics import TOPICS, BusName, Delivery
from recording import rows, tables
from recording.config import RecordConfig
from recording.database import Database, versions
from recording.frame_aggregator import FrameAggregator
from recording.limits import (
    MAX_PROCESSES,
    MAX_PROGRESS_AGENTS,
    MAX_PROGRESS_JUNCTIONS,
    MAX_TOTAL_DROPS,
)
from recording.losses import BusGaps, DropCounts, RestartGaps
from recording.observation import Observation, ObservedJunction


@dataclass(slots=True)
class ProgressTracker:
    """Collects progress between two reports; rates are per simulated second, as agents see them."""

    frame_period_ns: int
    observation: Observation
    frame: int = 0
    sim_time_ns: int = 0
    vehicles: int = 0
    cavs: int = 0
    cvs: int = 0
    state: str = ""
    end_to_end_ns: int = 0
    region_end_to_end_ns: dict[str, int] = field(default_factory=dict)
    _detections: dict[str, int] = field(default_factory=dict)
    payload_bytes: Counter[str] = field(default_factory=Counter)
    region_bytes: Counter[str] = field(default_factory=Counter)
    _since: tuple[int, int] | None = None

    def ticked(self, tick: Tick, now_ns: int) -> None:
        """Registers the world's tick."""
        equipment = tick.equipment.tolist()
        self.frame, self.sim_time_ns = tick.frame, tick.sim_time_ns
        self.vehicles = tick.bodies
        self.cavs = equipment.count(Equipment.CAV)
        self.cvs = equipment.count(Equipment.CV)
        if self._since is None:
            self._since = (tick.sim_time_ns - self.frame_period_ns, now_ns)

    def detected(self, region: str, vehicles: int) -> None:
        """Registers how many vehicles a region detected in its last frame."""
        self._detections[region] = vehicles

    def measured(self, metrics: Metrics) -> None:
        """Adds sent bytes; agents beyond the limit are not reported."""
        for upload in metrics.uploads:
            if upload.agent in self.payload_bytes or len(self.payload_bytes) < MAX_PROGRESS_AGENTS:
                self.payload_bytes[upload.agent] += upload.payload_bytes
            if upload.region in self.observation.regions:
                self.region_bytes[upload.region] += upload.payload_bytes

    def took(self, frame: tables.FrameRow, regions: Iterable[tables.RegionFrameRow]) -> None:
        """Registers the end-to-end time of the newest frame, if known."""
        self.end_to_end_ns = frame.end_to_end_ns or self.end_to_end_ns
        self.region_end_to_end_ns |= {
            row.region: row.end_to_end_ns for row in regions if row.end_to_end_ns
        }

    def report(self, now_ns: int, drops: int) -> Progress:
        """Returns the progress since the last report, and resets."""
        sim_ns, wall_ns = self._since or (self.sim_time_ns, now_ns)
        sim_passed_ns, wall_passed_ns = self.sim_time_ns - sim_ns, now_ns - wall_ns
        self._since = (self.sim_time_ns, now_ns)
        # Mbit/s = 8e-6 Mbit per byte over 1e-9 s per ns
        mbps_per_byte = 8e3 / sim_passed_ns if sim_passed_ns > 0 else 0.0
        mbps = {agent: count * mbps_per_byte for agent, count in sorted(self.payload_bytes.items())}
        regions = {name: self._region(name, mbps_per_byte) for name in self.observation.regions}
        self.payload_bytes.clear()
        self.region_bytes.clear()
        return Progress(
            frame=self.frame,
            sim_time_ns=self.sim_time_ns,
            real_time_factor=sim_passed_ns / wall_passed_ns if wall_passed_ns > 0 else 0.0,
            vehicles=self.vehicles,
            cavs=self.cavs,
            cvs=self.cvs,
            detections=sum(self._detections.values()),
            mbps=mbps,
            end_to_end_ms=self.end_to_end_ns / 1e6,
            state=self.state,
            drops=drops,
            regions=regions,
            junctions={one.tls: self._junction(one) for one in self._first_junctions()},
        )

    def _region(self, name: str, mbps_per_byte: float) -> RegionProgress:
        one = self.observation.regions[name]
        return RegionProgress(
            agents=one.agents,
            detections=self._detections.get(name, 0),
            frames=one.frames,
            incomplete=one.incomplete,
            mbps=self.region_bytes[name] * mbps_per_byte,
            end_to_end_ms=self.region_end_to_end_ns.get(name, 0) / 1e6,
        )

    def _first_junctions(self) -> Iterable[ObservedJunction]:
        return islice(self.observation.junctions.values(), MAX_PROGRESS_JUNCTIONS)

    def _junction(self, one: ObservedJunction) -> JunctionProgress:
        return JunctionProgress(
            region=one.region,
            phase=-1 if one.phase is None else one.phase,
            unchanged_s=one.unchanged_s(self.sim_time_ns),
            vehicles=one.vehicles,
            queued=one.queued,
            coverage=one.coverage,
        )


PATIENCE_NS = 10_000_000_000  # in a flood on a loaded machine messages are seconds late
SILENCE_NS = 150_000_000


class EndOfRun:
    """Waits for late messages: topics of two buses and many processes have no common order."""

    def __init__(self, last_to_publish: Collection[str], regions: int) -> None:
        """The last frame is complete once these processes have published, of so many regions."""
        self._last_to_publish = frozenset(last_to_publish)
        self._regions = regions
        self._began_ns: int | None = None
        self._awaits_last_frame = True
        self._received_ns = 0

    def begin(self, now_ns: int, *, in_time: bool) -> None:
        """Handles the end of the world; if that is early, the last frame is not waited for."""
        self._began_ns = now_ns
        self._awaits_last_frame = in_time

    def received(self, now_ns: int) -> None:
        """Registers that a message arrived."""
        self._received_ns = max(self._received_ns, now_ns)

    def is_over(self, now_ns: int, aggregator: FrameAggregator) -> bool:
        """Whether the last frame is complete and no messages arrive, or the timeout is over."""
        if self._began_ns is None:
            return False
        if now_ns - self._began_ns >= PATIENCE_NS:
            return True
        if self._awaits_last_frame and not self._is_complete(aggregator):
            return False
        return now_ns - self._received_ns >= SILENCE_NS

    def _is_complete(self, aggregator: FrameAggregator) -> bool:
        last = aggregator.get(aggregator.newest_tick)
        if last is None or not last.received >= self._last_to_publish:
            return False
        detected = [one for one in last.regions.values() if one.detections is not None]
        return len(detected) >= self._regions


COMMIT_NS = 1_000_000_000
COMMIT_ROWS = 5_000
PROGRESS_NS = 1_000_000_000
_log = logging.getLogger(__name__)
_LOOK_NS = 5_000_000  # less than any reconnection takes
_SUBSCRIBED_LAST = ("tick", "state")  # of each bus one: when it arrives, all others arrive too


class RecordRole:
    """The record role: writes a run's messages to its database; never delays a frame."""

    def __init__(self, context: Context) -> None:
        """Opens the database and subscribes.

        Raises:
            ConfigError: the run folder cannot take a recording.
        """
        scenario = context.setup.scenario
        self._context = context
        self._config = RecordConfig.model_validate(scenario.get("record", {}))
        self._frame_period_ns = round(float(scenario.get("frame_period_s", 0.1)) * 1e9)
        written = json.dumps(scenario)
        self._database = Database(context.run_dir, written)
        self._is_broken = False
        regions: dict[str, list[str]] = scenario["regions"]
        self._aggregator = FrameAggregator(self._frame_period_ns, regions, self._database.last_tick)
        self._progress = ProgressTracker(
            self._frame_period_ns, Observation(context.setup.road_map, regions)
        )
        last = [one for role in ("edge", "signal") for one in region_instances(role, regions)]
        self._ending = EndOfRun([one.id for one in last], len(regions))
        self._clocks: dict[str, tuple[int, int]] = {}
        self._drops = DropCounts(self._database.known_drops())
        self._last_request = -1 if self._database.last_whole is None else self._database.last_whole
        self._return: RestartGaps | None = None
        self._looked_ns = 0
        self._reaches = [BusGaps(BusName.V2X, context.v2x), BusGaps(BusName.WORLD, context.world)]
        self._commit_ns = COMMIT_NS if scenario.get("mode") == "lockstep" else 0
        self._committed_ns = self._told_ns = time.monotonic_ns()
        self._acted_frame = -1
        self._first_tls = min(tls for junctions in regions.values() for tls in junctions)
        self._handlers = self._routes()
        resumed = self._database.last_frame
        if resumed is None:
            self._begin(written)
        else:
            _log.warning("the recording goes on after frame %d", resumed)
            self._aggregator.settle(resumed)
            self._return = RestartGaps(self._last_request)

    @classmethod
    def build(cls, context: Context) -> RecordRole:
        """Makes the role and announces that it is ready."""
        role = cls(context)
        context.inbox.set_quotas(is_paced=context.setup.scenario.get("mode") != "lockstep")
        context.world.watch()  # present processes have a quota of their own
        for name in sorted(role._handlers, key=_SUBSCRIBED_LAST.__contains__):
            topic = TOPICS[name]
            bus = context.world if topic.bus is BusName.WORLD else context.v2x
            bus.subscribe(name)
        context.announce("record")
        return role

    def on(self, item: Envelope | Presence) -> None:
        """Handles a message; one of an implausible frame is counted and dropped."""
        if isinstance(item, Presence) or item.topic not in self._handlers:
            return
        self._look(time.monotonic_ns())
        try:
            self._handlers[item.topic](item.message, item)
            self._note_gaps(item)
        except MessageError as error:
            self._context.inbox.refuse(item.topic, error)
        if item.topic != "clock":  # which is about no frame, and continues
            self._ending.received(item.received_ns)
        if self._database.is_full:
            self._commit(time.monotonic_ns())

    def poll(self) -> None:
        """Commits and reports when it is time, and stops once the run is written."""
        now_ns = time.monotonic_ns()
        self._look(now_ns)
        due = now_ns - self._committed_ns >= self._commit_ns
        if due or self._database.pending_rows >= COMMIT_ROWS:
            self._commit(now_ns)
        if self._aggregator.newest_tick >= 0 and now_ns - self._told_ns >= PROGRESS_NS:
            self._tell(now_ns)
        if self._ending.is_over(now_ns, self._aggregator):
            self._context.stop.set()

    def close(self) -> None:
        """Writes the rest and leaves one plain file, unless the disk has failed before."""
        if self._is_broken:
            return
        self._commit(time.monotonic_ns())
        self._database.close()

    def _routes(self) -> dict[str, Callable[[Any, Envelope], None]]:
        routes: dict[str, Callable[[Any, Envelope], None]] = {
            "tick": self._on_tick,
            "trips": self._on_trips,
            "metrics": self._on_metrics,
            "clock": self._on_clock,
            "end": self._on_end,
            "state": self._on_state,
            "request": self._on_request,
            "detections": self._on_detections,
            "lanes": self._on_lanes,
        }
        if self._config.truth:
            routes["truth"] = self._on_truth
            routes["sighting"] = self._on_sighting
        if self._config.snapshot_period_s:
            routes["scan"] = self._on_scan
        return routes

    def _on_tick(self, tick: m.Tick, item: Envelope) -> None:
        note = self._aggregator.tick(tick.frame, tick.sim_time_ns)
        self._progress.ticked(tick, item.received_ns)
        note.sim_time_ns, note.tick_ns = tick.sim_time_ns, item.received_ns
        note.vehicles, note.cavs, note.cvs = (
            self._progress.vehicles,
            self._progress.cavs,
            self._progress.cvs,
        )

    def _on_truth(self, truth: m.Truth, _: Envelope) -> None:
        self._aggregator.check(truth.frame)
        self._database.add(tables.TruthRow, rows.truth_rows(truth))

    def _on_sighting(self, sighting: m.Sighting, _: Envelope) -> None:
        self._aggregator.check(sighting.frame)
        self._database.add(tables.SightingRow, [rows.sighting_row(sighting)])

    def _on_trips(self, trips: m.Trips, _: Envelope) -> None:
        self._database.add(tables.TripRow, rows.trip_rows(trips))

    def _on_metrics(self, metrics: m.Metrics, _: Envelope) -> None:
        self._drops.received(metrics.process, metrics.drops)
        self._aggregator.measured(metrics)
        self._progress.measured(metrics)
        if any(span.stage == "actuate" for span in metrics.spans):
            self._acted_frame = max(self._acted_frame, metrics.frame)
        self._database.add(tables.StageRow, rows.stage_rows(metrics))
        self._database.add(tables.AgentScoreRow, rows.agent_score_rows(metrics))
        self._database.add(tables.AlignmentRow, rows.alignment_rows(metrics))

    def _on_clock(self, reading: m.ClockReading, _: Envelope) -> None:
        if reading.process not in self._clocks and len(self._clocks) >= MAX_PROCESSES:
            raise MessageError(f"{reading.process} is one process more than {MAX_PROCESSES}")
        found = (reading.offset_ns, reading.error_ns)
        self._clocks[reading.process] = found
        self._database.add(tables.ClockRow, [tables.ClockRow(reading.process, *found)])

    def _on_end(self, end: m.End, item: Envelope) -> None:
        self._ending.begin(item.received_ns, in_time=end.reason == "finished")
        facts = {
            "end_frames": str(end.frames),
            "end_reason": end.reason,
            "end_waiting": str(end.waiting),
        }
        self._database.add(tables.MetaRow, facts.items())
        if self._config.truth:
            setup = self._context.setup
            self._database.add(tables.VehicleTypeRow, rows.vehicle_type_rows(setup))
            self._database.add(tables.ParkedRow, rows.parked_rows(setup))

    def _on_state(self, state: m.SignalState, _: Envelope) -> None:
        self._aggregator.check(state.frame)
        if state.tls == self._first_tls:  # the progress line has room for one
            self._progress.state = state.state
        self._progress.observation.take(state)
        self._database.add(tables.PhaseRow, [rows.phase_row(state)])

    def _on_request(self, request: m.SignalRequest, item: Envelope) -> None:
        record = self._aggregator.signal_region(request.frame, request.tls)
        record.requested(item.received_ns)
        self._last_request = max(self._last_request, request.frame)
        self._database.add(tables.RequestRow, [rows.request_row(request)])

    def _on_detections(self, detections: m.Detections, item: Envelope) -> None:
        region = item.parts["region"]
        record = self._aggregator.region(detections.frame, region)
        self._database.add(tables.DetectionRow, rows.detection_rows(detections, region))
        record.detections = observed = int((detections.coasted_s == 0).sum())
        self._progress.detected(region, observed)

    def _on_lanes(self, lanes: m.LaneCounts, _: Envelope) -> None:
        self._aggregator.signal_region(lanes.frame, lanes.tls).counted(lanes)
        self._progress.observation.take(lanes)
        self._database.add(tables.CountRow, rows.count_rows(lanes))

    def _on_scan(self, scan: m.Scan, item: Envelope) -> None:
        self._aggregator.check(scan.frame)
        period_ns = round(self._config.snapshot_period_s * 1e9)
        if scan.sim_time_ns % period_ns < self._frame_period_ns:
            self._database.add(tables.CloudRow, [rows.cloud_row(scan, item.parts["region"])])

    def _look(self, now_ns: int) -> None:
        """Checks the routers, but not for each of many messages that came at once."""
        if now_ns - self._looked_ns < _LOOK_NS:
            return
        self._looked_ns = now_ns
        for reach in self._reaches:
            reach.look(self._last_request, now_ns)

    def _note_gaps(self, received: Envelope) -> None:
        """Records the gaps that a message ends; metrics do not, as they are of earlier frames."""
        frame = getattr(received.message, "frame", None)
        topic = TOPICS[received.topic]
        if frame is None or topic.delivery is Delivery.TELEMETRY:
            return
        found = [reach.received(topic.bus, frame, received.received_ns) for reach in self._reaches]
        if self._return is not None and topic.name in _SUBSCRIBED_LAST:
            found.append(self._return.received(topic.bus, frame))
        self._database.add(tables.GapRow, filter(None, found))

    def _begin(self, scenario: str) -> None:
        used = versions()
        facts = {
            "scenario": scenario,
            "version": used.get("cpnet-edge", "unknown"),  # a checkout that was never installed
            "versions": json.dumps(used),
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        self._database.add(tables.MetaRow, facts.items())
        self._commit(time.monotonic_ns())

    def _commit(self, now_ns: int) -> None:
        for note in self._aggregator.take_changed():
            found = note.rows(self._clocks)
            self._database.add(tables.FrameRow, [found.frame])
            self._database.add(tables.RegionFrameRow, found.regions)
            self._database.add(tables.LatencyRow, found.latencies)
            self._database.add(tables.UploadRow, found.uploads)
        self._count_own_drops()
        self._database.add(tables.DropRow, self._drops.take_changed())
        try:
            self._database.commit()
        except sqlite3.OperationalError as error:
            self._is_broken = True
            raise CpnetError(f"{self._database.path} cannot be written: {error}") from None
        self._committed_ns = now_ns

    def _tell(self, now_ns: int) -> None:
        acted = self._aggregator.get(self._acted_frame)
        if acted is not None:
            found = acted.rows(self._clocks)
            self._progress.took(found.frame, found.regions)
        drops = min(self._drops.total(), MAX_TOTAL_DROPS)
        self._context.world.publish("progress", self._progress.report(now_ns, drops))
        self._told_ns = now_ns

    def _count_own_drops(self) -> None:
        own = dict(self._context.inbox.drops)
        if self._database.refused_rows:
            own["refused_row"] = self._database.refused_rows
        self._drops.received(self._context.id, own)
