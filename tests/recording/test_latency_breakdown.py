"""Latency breakdown: stages follow one another and sum to the end-to-end time."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.messages import Arrival, Span, Upload
from recording.latency_breakdown import FrameTimings, stage_sum_ns
from recording.tables import LatencyRow

MS = 1_000_000
HOSTS = {"a": "vehicle-0", "b": "vehicle-1"}


def span(stage: str, start_ms: float, end_ms: float, agent: str = "") -> Span:
    return Span(stage=stage, agent=agent, start_ns=round(start_ms * MS), end_ns=round(end_ms * MS))


def upload(agent: str, chunk: int, sent_ms: float, link_ms: float | None = None) -> Upload:
    return Upload(
        agent=agent,
        region="r0",
        chunk=chunk,
        points=1,
        payload_bytes=1,
        sense_start_ns=0,
        sense_end_ns=4 * MS,
        encode_end_ns=round((sent_ms - 1) * MS),
        sent_ns=round(sent_ms * MS),
        link_sim_ns=None if link_ms is None else round(link_ms * MS),
    )


def arrival(agent: str, chunk: int, at_ms: float) -> Arrival:
    return Arrival(
        agent=agent, chunk=chunk, received_ns=round(at_ms * MS), decoded_ns=round((at_ms + 2) * MS)
    )


def timings(link_ms: Mapping[str, float] | None = None) -> FrameTimings:
    """Two agents: a sends two chunks, b one; the edge is ready at 40 ms, the cabinet at 60.

    On a virtual link a's second chunk comes 3 ms after its first.
    """
    link = link_ms or {}
    made = FrameTimings("r0", complete=True)
    made.senders |= HOSTS
    for agent, chunks in (("a", 2), ("b", 1)):
        spans = made.agents[agent]
        spans += [span("sense", 0, 4, agent), span("select", 4, 5, agent)]
        for chunk in range(chunks):
            sent = 9 + 4 * chunk
            spans += [
                span("encode", sent - 3, sent - 1, agent),
                span("send", sent - 1, sent, agent),
            ]
            on_link = link[agent] + 3 * chunk if agent in link else None
            made.uploads[agent, chunk] = upload(agent, chunk, sent, on_link)
            came = 20 + 5 * chunk
            made.arrivals[agent, chunk] = arrival(agent, chunk, came)
            made.edge += [
                span("decode", came, came + 2, agent),
                span("place", came + 2, came + 3, agent),
            ]
    made.edge.append(span("wait", 20, 40))
    ends = [40, 41, 42, 46, 51, 52, 52.5, 53]
    for stage, start, end in zip(
        ("check", "merge", "ground", "detect", "fuse", "track", "count"),
        ends,
        ends[1:],
        strict=False,
    ):
        made.edge.append(span(stage, start, end))
    made.signal.append(span("decide", 54, 55))
    made.actuations.append(span("actuate", 57, 60))
    return made


def in_ms(row: LatencyRow) -> dict[str, float]:
    names = [name for name in row._fields if name.endswith("_ns")]
    return {name.removesuffix("_ns"): getattr(row, name) / MS for name in names}


def test_the_stages_of_a_frame_sum_to_its_end_to_end_time() -> None:
    a, b = timings().latencies(7, {})
    assert (a.frame, a.agent, b.agent) == (7, "a", "b")
    assert in_ms(a) == {
        "sense": 4, "select": 1, "encode": 4, "send": 2, "link": 12, "decode": 2, "place": 1,
        "wait": 12, "check": 1, "merge": 1, "ground": 4, "detect": 5, "fuse": 1, "border": 0,
        "track": 0.5, "count": 0.5, "decide": 1, "actuate": 3, "other": 5,
        "end_to_end": 60, "clock_error": 0,
    }  # fmt: skip
    assert stage_sum_ns(b) == b.end_to_end_ns == 60 * MS


def test_time_in_which_two_chunks_of_an_agent_were_opened_counts_once() -> None:
    made = timings()
    for chunk in (0, 1):
        made.arrivals["a", chunk] = arrival("a", chunk, 20)
    others = [s for s in made.edge if s.agent != "a"]
    made.edge = [
        *others,
        span("decode", 22, 28, "a"),
        span("place", 28, 30, "a"),
        span("decode", 21, 25, "a"),
        span("place", 25, 27, "a"),
    ]
    a, _ = made.latencies(7, {})
    assert (in_ms(a)["decode"], in_ms(a)["place"], in_ms(a)["wait"]) == (4 + 3, 2, 11)
    assert stage_sum_ns(a) == a.end_to_end_ns == 60 * MS


def test_only_what_was_used_counts() -> None:
    made = timings()
    del made.arrivals["a", 1], made.arrivals["b", 0]
    (row,) = made.latencies(1, {})
    assert (row.agent, in_ms(row)["link"], in_ms(row)["encode"]) == ("a", 11, 2)


def test_without_the_cabinets_word_there_is_no_account_yet() -> None:
    made = timings()
    made.actuations.clear()
    assert made.latencies(1, {}) == []
    assert made.unused_end_to_end_ns({}, 5) is None


@settings(deadline=None)
@given(st.integers(-(10**15), 10**15), st.integers(-(10**15), 10**15), st.integers(0, 10**6))
def test_clocks_of_other_machines_are_aligned_and_their_error_is_kept(vehicle, edge, error) -> None:
    there = timings()
    held = [*((spans, vehicle) for spans in there.agents.values()), (there.edge, edge)]
    for spans, offset in held:
        shift = {"start_ns": -offset, "end_ns": -offset}
        spans[:] = [
            s.model_copy(update={k: getattr(s, k) + v for k, v in shift.items()}) for s in spans
        ]
    stamps = ("sense_start_ns", "sense_end_ns", "encode_end_ns", "sent_ns")
    for key, sent in there.uploads.items():
        moved = {name: getattr(sent, name) - vehicle for name in stamps}
        there.uploads[key] = sent.model_copy(update=moved)
    for key, came in there.arrivals.items():
        moved = {"received_ns": came.received_ns - edge, "decoded_ns": came.decoded_ns - edge}
        there.arrivals[key] = came.model_copy(update=moved)
    clocks = {"vehicle-0": (vehicle, error), "vehicle-1": (vehicle, error), "edge-r0": (edge, 7)}
    expected = [row._replace(clock_error_ns=error + 7) for row in timings().latencies(1, {})]
    assert there.latencies(1, clocks) == expected


def test_an_arrival_before_the_call_returned_leaves_no_negative_link() -> None:
    made = timings()
    made.arrivals["b", 0] = arrival("b", 0, 8.75)
    b = made.latencies(1, {})[1]
    assert (in_ms(b)["send"], in_ms(b)["link"]) == (0.75, 0)
    assert stage_sum_ns(b) == b.end_to_end_ns


def test_over_virtual_links_each_agents_time_is_laid_end_to_end() -> None:
    a, b = timings({"a": 30, "b": 70}).latencies(1, {})
    assert in_ms(a)["link"] == 30  # the second chunk was computed while the first was under way
    assert in_ms(b)["link"] == 70
    assert in_ms(b)["wait"] == 0
    assert in_ms(a)["wait"] == 37  # b: 8 ms until sent, a: 11
    assert a.end_to_end_ns == b.end_to_end_ns == (8 + 70 + 3 + 13 + 1 + 3) * MS
    assert {a.other_ns, b.other_ns} == {0}
    for row in (a, b):
        assert stage_sum_ns(row) == row.end_to_end_ns


def test_a_virtual_frame_that_missed_something_took_until_the_deadline() -> None:
    made = timings({"a": 30, "b": 70})
    del made.arrivals["b", 0]
    made.complete, made.delay_sim_ns = False, 80 * MS
    (a,) = made.latencies(1, {})
    assert a.end_to_end_ns == (80 + 17) * MS
    assert in_ms(a)["wait"] == 80 - 44
    del made.arrivals["a", 0], made.arrivals["a", 1]
    assert made.latencies(1, {}) == []
    assert made.unused_end_to_end_ns({}, None) == 80 * MS


@pytest.mark.parametrize("start_ms", [-70_000, 61])
def test_what_took_more_than_a_minute_or_less_than_nothing_is_left_out(start_ms) -> None:
    made = timings()
    for key, sent in made.uploads.items():
        made.uploads[key] = sent.model_copy(update={"sense_start_ns": start_ms * MS})
    assert made.latencies(1, {}) == []


def test_a_link_that_is_free_before_the_next_chunk_is_ready_waits_for_it() -> None:
    made = timings({"a": 1, "b": 1})
    (a, _) = made.latencies(1, {})
    assert in_ms(a)["link"] == 4  # nothing was queued before it
