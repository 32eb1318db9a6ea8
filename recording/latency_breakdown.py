"""Latency breakdown: the time of a frame by stage, for each agent whose scan was used.

On an agent's path the stages follow one another; `wait` is the time that its last chunk waited at
the edge, for others or for its turn, `other` the time that no process measured. They sum to the
end-to-end time: from the start of the agent's sensing until the cabinet has acted on the frame. The
edge opens several scans at once: others' are no part of an agent's path, and where chunks of its
own overlap, the time counts once.

Over real links, clocks of different machines are aligned first, and `clock_error_ns` bounds the
error of that. Over virtual links each agent's computing time, as measured, and its time on the link
are combined as if every agent had a computer of its own: a chunk is computed while those before it
are on the link, so that of `link` only the time after the computing counts.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from operator import itemgetter

from protocol.instances import WORLD_HOST, region_instances
from protocol.messages import Arrival, Span, Upload
from recording.limits import MAX_END_TO_END_NS
from recording.tables import LatencyRow

SENDER_STAGES = ("sense", "select", "encode", "send")
EDGE_STAGES = ("check", "merge", "ground", "detect", "fuse", "border", "track", "count")
SAME_CLOCK = (0, 0)
Clocks = Mapping[str, tuple[int, int]]


@dataclass(slots=True)
class FrameTimings:
    """Timings of one frame of one region, measured by several processes.

    `edge`, `signal` and `actuations` are spans of its edge, its signal process and its cabinets;
    `agents` those of agents by their id, whatever the region; `senders` their processes.
    """

    region: str
    agents: dict[str, list[Span]] = field(default_factory=lambda: defaultdict(list))
    edge: list[Span] = field(default_factory=list)
    signal: list[Span] = field(default_factory=list)
    actuations: list[Span] = field(default_factory=list)
    senders: dict[str, str] = field(default_factory=dict)
    uploads: dict[tuple[str, int], Upload] = field(default_factory=dict)
    arrivals: dict[tuple[str, int], Arrival] = field(default_factory=dict)
    delay_sim_ns: int | None = None
    complete: bool | None = None

    def latencies(self, frame: int, clocks: Clocks) -> list[LatencyRow]:
        """Returns a row for each agent whose scan was used; none until the cabinets have acted.

        `clocks` gives by process the offset to the reference clock, and its largest error, both in
        ns.
        """
        acted = self._acted()
        ready = [span.end_ns for span in self.edge if span.stage == "wait"]
        used = self._last_chunks()
        if acted is None or not ready or not used:
            return []
        ways = list(self._ways(frame, used))
        if all(upload.link_sim_ns is not None for upload, _ in used):
            return self._virtual(ways, acted)
        rows = [self._real(way, ready[-1], acted, clocks) for way in ways]
        return [row for row in rows if row is not None]

    def unused_end_to_end_ns(self, clocks: Clocks, tick_ns: int | None) -> int | None:
        """Returns the time of a frame of which no scan was used, from sensing or from the tick."""
        acted = self._acted()
        if acted is None:
            return None
        if self.delay_sim_ns is not None:
            return self.delay_sim_ns
        starts_ns = [
            upload.sense_start_ns + clocks.get(self.senders[upload.agent], SAME_CLOCK)[0]
            for upload in self.uploads.values()
        ]
        start_ns = min(starts_ns, default=tick_ns)
        if start_ns is None:
            return None
        sim_ns = clocks.get(WORLD_HOST, SAME_CLOCK)[0]
        took_ns = acted.end_ns + sim_ns - start_ns
        in_order = acted.start_ns + sim_ns >= start_ns
        return took_ns if in_order and took_ns <= MAX_END_TO_END_NS else None

    def _acted(self) -> Span | None:
        """Returns when the last of the region's cabinets acted."""
        return max(self.actuations, key=lambda span: span.end_ns, default=None)

    def _last_chunks(self) -> list[tuple[Upload, Arrival]]:
        """Returns, by agent, the chunk that came last of those that were used."""
        last: dict[str, tuple[Upload, Arrival]] = {}
        for key in sorted(self.uploads.keys() & self.arrivals.keys()):
            pair = self.uploads[key], self.arrivals[key]
            agent = key[0]
            if agent not in last or _order(*pair) >= _order(*last[agent]):
                last[agent] = pair
        return list(last.values())

    def _ways(self, frame: int, used: Iterable[tuple[Upload, Arrival]]) -> Iterator[_AgentPath]:
        """Yields the measured timings of each agent, with the stages that serve all."""
        at_edge: dict[str, list[Span]] = defaultdict(list)
        for span in self.edge:
            at_edge[span.agent].append(span)
        shared, decided = _sums(at_edge[""]), _sums(self.signal)
        for_all = {f"{stage}_ns": shared.get(stage, 0) for stage in EDGE_STAGES}
        for upload, arrival in used:
            sent = self._sent(upload)
            opened = at_edge[upload.agent]
            came = _sums_apart(s for s in opened if s.start_ns >= arrival.received_ns)
            row = LatencyRow(
                frame,
                self.region,
                upload.agent,
                **{f"{stage}_ns": sent.get(stage, 0) for stage in SENDER_STAGES},
                link_ns=0,
                decode_ns=came.get("decode", 0),
                place_ns=came.get("place", 0),
                wait_ns=0,
                **for_all,
                decide_ns=decided.get("decide", 0),
                actuate_ns=0,
                other_ns=0,
                end_to_end_ns=0,
                clock_error_ns=0,
            )
            yield _AgentPath(row, upload, arrival)

    def _real(
        self, way: _AgentPath, ready_ns: int, acted: Span, clocks: Clocks
    ) -> LatencyRow | None:
        row, upload, arrival = way.row, way.upload, way.arrival
        sender, edge, sim = (
            clocks.get(process, SAME_CLOCK)
            for process in (self.senders[row.agent], edge_id(self.region), WORLD_HOST)
        )
        start_ns = upload.sense_start_ns + sender[0]
        took_ns = acted.end_ns + sim[0] - start_ns
        if acted.start_ns + sim[0] < start_ns or took_ns > MAX_END_TO_END_NS:
            return None
        link_ns = arrival.received_ns + edge[0] - upload.sent_ns - sender[0]
        overlap_ns = min(max(0, -link_ns), row.send_ns)  # it arrived before the call returned
        at_edge_ns = ready_ns - arrival.received_ns
        row = row._replace(
            send_ns=row.send_ns - overlap_ns,
            link_ns=link_ns + overlap_ns,
            wait_ns=at_edge_ns - row.decode_ns - row.place_ns,
            actuate_ns=acted.end_ns - acted.start_ns,
            end_to_end_ns=took_ns,
            clock_error_ns=sender[1] + max(edge[1], sim[1]),
        )
        return row._replace(other_ns=took_ns - stage_sum_ns(row))

    def _virtual(self, ways: list[_AgentPath], acted: Span) -> list[LatencyRow]:
        rows = [way.row._replace(link_ns=self._virtual_link_ns(way)) for way in ways]
        there_ns = [_until_placed_ns(row) for row in rows]
        deadline_ns = 0 if self.complete else self.delay_sim_ns or 0
        ready_ns = max(*there_ns, deadline_ns)
        done = []
        for row, here_ns in zip(rows, there_ns, strict=True):
            actuate_ns = acted.end_ns - acted.start_ns
            waited = row._replace(wait_ns=ready_ns - here_ns, actuate_ns=actuate_ns)
            done.append(waited._replace(end_to_end_ns=stage_sum_ns(waited)))
        return done

    def _virtual_link_ns(self, way: _AgentPath) -> int:
        """Returns the part of an agent's time on a virtual link after its last chunk was sent.

        In simulated time, all chunks were queued at once, each behind the one before it; here each
        is queued when it was ready.
        """
        agent, there_ns, before_ns = way.upload.agent, 0, 0
        for chunk in range(way.upload.chunk + 1):
            upload = self.uploads.get((agent, chunk))
            if upload is None:
                continue
            took_ns = upload.link_sim_ns or 0
            ready_ns = sum(self._sent(upload).values())
            queued = there_ns > ready_ns
            there_ns = there_ns + max(took_ns - before_ns, 0) if queued else ready_ns + took_ns
            before_ns = took_ns
        return there_ns - sum(self._sent(way.upload).values())

    def _sent(self, upload: Upload) -> dict[str, int]:
        """Returns an agent's computing time by stage until it had sent a chunk."""
        mine = self.agents.get(upload.agent, ())
        return _sums(span for span in mine if span.end_ns <= upload.sent_ns)


def edge_id(region: str) -> str:
    """Returns the process of a region's edge."""
    return region_instances("edge", [region])[0].id


@dataclass(frozen=True, slots=True)
class _AgentPath:
    row: LatencyRow
    upload: Upload
    arrival: Arrival


_NO_STAGE = ("frame", "region", "agent", "end_to_end_ns", "clock_error_ns")
_stages_of = itemgetter(*(i for i, n in enumerate(LatencyRow._fields) if n not in _NO_STAGE))


def stage_sum_ns(row: LatencyRow) -> int:
    """Returns the sum of all stages of a row, `other` included."""
    return sum(_stages_of(row))


def _until_placed_ns(row: LatencyRow) -> int:
    sent_ns = row.sense_ns + row.select_ns + row.encode_ns + row.send_ns
    return sent_ns + row.link_ns + row.decode_ns + row.place_ns


def _order(upload: Upload, arrival: Arrival) -> tuple[int, int]:
    return upload.link_sim_ns or 0, arrival.received_ns


def _sums(spans: Iterable[Span]) -> dict[str, int]:
    sums: dict[str, int] = defaultdict(int)
    for span in spans:
        sums[span.stage] += span.end_ns - span.start_ns
    return sums


def _sums_apart(spans: Iterable[Span]) -> dict[str, int]:
    """Returns sums by stage; overlapping time counts for the earlier span alone."""
    sums: dict[str, int] = defaultdict(int)
    ordered = sorted(spans, key=lambda span: (span.start_ns, span.end_ns))
    until_ns = ordered[0].start_ns if ordered else 0
    for span in ordered:
        sums[span.stage] += max(0, span.end_ns - max(span.start_ns, until_ns))
        until_ns = max(until_ns, span.end_ns)
    return sums
