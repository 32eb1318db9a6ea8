"""The MCAP recorder as a whole: its subscriptions, what it records, when it ends."""

from __future__ import annotations

import json
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_rig import envelope, setup

from protocol.in_process import InProcessRouter
from protocol.inbox import Envelope, Inbox, Presence
from protocol.observer import ALL_TOPICS
from protocol.process import Context, loop
from protocol.topics import TOPICS, BusName
from recording.mcap import recorder
from recording.mcap.format import next_file
from recording.mcap.reader import McapReader
from recording.mcap.recorder import (
    PATIENCE_NS,
    SILENCE_NS,
    TRUTH_TOPICS,
    EndOfRecording,
    McapRecorder,
)

pytest.importorskip("mcap", reason="needs the extra `mcap`")


@pytest.fixture(autouse=True)
def stay_nice(monkeypatch):
    monkeypatch.setattr(recorder, "lower_priority", lambda: None)


def context_in(folder, record) -> Context:
    """Returns the context of a recorder, on in-process buses."""
    asked = setup()
    scenario = {
        "name": "n",
        "mode": "lockstep",
        "seed": 1,
        "regions": {"r0": ["J"]},
        "record": record,
    }
    made = asked.model_copy(update={"scenario": scenario})
    inbox, stop = Inbox(), threading.Event()
    world, v2x = (InProcessRouter(name).bus(inbox) for name in (BusName.WORLD, BusName.V2X))
    return Context("mcap", made, folder, world, v2x, inbox, stop, lambda: v2x)


def publish(context, topic: str) -> None:
    bus = context.world if TOPICS[topic].bus is BusName.WORLD else context.v2x
    item = envelope(topic, 0)
    bus.deliver(topic, item.data, **item.parts | {"region": "r0"})


@pytest.mark.parametrize("truth", [True, False])
def test_all_topics_of_both_buses_are_kept_but_truth_that_nobody_wants(tmp_path, truth):
    context = context_in(tmp_path, {"mcap": True, "truth": truth})
    writing = recorder.build(context)
    for topic in sorted(ALL_TOPICS - {"end"}):
        publish(context, topic)
    publish(context, "end")
    loop(writing, context.inbox, context.stop)  # until it is over
    writing.close()
    recording = McapReader(tmp_path)
    assert {item.topic for item in recording.messages()} == ALL_TOPICS - (
        set() if truth else TRUTH_TOPICS
    )
    assert recording.facts["truth"] == json.dumps(truth)
    assert recording.is_whole


def test_the_messages_of_all_regions_are_kept(tmp_path):
    context = context_in(tmp_path, {"mcap": True})
    writing = recorder.build(context)
    item = envelope("detections", 0)
    context.v2x.deliver("detections", item.data, region="r1")
    context.v2x.deliver("detections", item.data, region="r0")
    found = [one for one in iter(context.inbox.get, None) if isinstance(one, Envelope)]
    assert [one.parts for one in found] == [{"region": "r1"}, {"region": "r0"}]
    writing.close()


def test_the_recording_says_at_its_end_what_came_of_it(tmp_path):
    inbox = Inbox()
    writing = McapRecorder(
        setup(), lambda: next_file(tmp_path), inbox, threading.Event(), truth=True
    )
    inbox.drops["inbox_full"] = 3
    for topic in ("tick", "end"):
        writing.on(envelope(topic, time.monotonic_ns()))
    assert writing.dropped == 3
    writing.close()
    with (tmp_path / "run.mcap").open("rb") as file:
        closing = [one.metadata for one in make_reader(file).iter_metadata()][-1]
    end = envelope("end", 0).message
    assert closing == {
        "messages": "2",
        "drops": '{"inbox_full": 3}',
        "end_reason": end.reason,
    }


def test_what_nobody_could_read_is_not_kept_and_the_rest_as_it_came(tmp_path):
    context = context_in(tmp_path, {"mcap": True})
    writing = recorder.build(context)
    good = envelope("detections", 0).data
    odd = good[:24] + b"\xc1" + good[25:]  # no msgpack
    for data in (b"junk", good[:-8], odd, good):
        context.v2x.deliver("detections", data, region="r0")
    publish(context, "end")
    loop(writing, context.inbox, context.stop)
    writing.close()
    recording = McapReader(tmp_path)
    assert [item.data for item in recording.messages(["detections"])] == [good]
    assert (writing.dropped, recording.drops.total()) == (3, 0)


def test_who_never_falls_silent_keeps_no_recording_from_ending(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "PATIENCE_NS", 1)
    inbox, stop = Inbox(), threading.Event()
    writing = McapRecorder(setup(), lambda: next_file(tmp_path), inbox, stop, truth=True)
    inbox.put(Presence("vehicle", "v", alive=True))
    writing.poll()
    assert not stop.is_set()
    writing.on(envelope("end", 0))
    writing.poll()
    assert stop.is_set()
    writing.close()


def test_a_recording_is_over_when_the_recorder_is_gone_and_nobody_speaks():
    recorder = EndOfRecording()
    recorder.look(Presence("record", "record", alive=True, bus=BusName.WORLD), 0)
    recorder.received(5)
    assert not recorder.is_over(10**12)
    recorder.begin(10)
    assert not recorder.is_over(SILENCE_NS * 2)
    recorder.look(Presence("record", "record", alive=False, bus=BusName.WORLD), 20)
    assert not recorder.is_over(5 + SILENCE_NS - 1)
    assert recorder.is_over(5 + SILENCE_NS)
    recorder.received(SILENCE_NS)
    assert not recorder.is_over(5 + SILENCE_NS)


@given(st.lists(st.integers(0, PATIENCE_NS * 2)))
def test_patience_has_an_end(times_ns):
    recorder = EndOfRecording()
    recorder.look(Presence("record", "record", alive=True), 0)
    recorder.begin(0)
    for now_ns in sorted(times_ns):
        recorder.received(now_ns)
        assert recorder.is_over(now_ns) == (now_ns >= PATIENCE_NS)


def test_without_a_world_nothing_more_is_awaited():
    recorder = EndOfRecording()
    recorder.look(Presence("edge", "edge", alive=False), 0)
    assert not recorder.is_over(10**12)
    recorder.look(Presence("sim", "sim", alive=False, bus=BusName.WORLD), 7)
    assert recorder.is_over(7 + SILENCE_NS)


def test_a_recording_outlives_the_edge_and_a_short_loss_of_the_world():
    recorder = EndOfRecording()
    recorder.look(Presence("record", "record", alive=True, bus=BusName.V2X), 0)
    for gone in ("edge", "record", "sim"):  # the edge's router goes, and all tokens with it
        recorder.look(Presence(gone, gone, alive=False, bus=BusName.V2X), 0)
    assert not recorder.is_over(10**12)
    recorder.look(Presence("record", "record", alive=True, bus=BusName.V2X), 0)
    for alive in (False, True):
        recorder.look(Presence("sim", "sim", alive=alive, bus=BusName.WORLD), 5)
        assert recorder.is_over(5 + PATIENCE_NS) != alive
    recorder.begin(10)
    recorder.look(Presence("sim", "sim", alive=True, bus=BusName.WORLD), 20)
    assert recorder.is_over(10 + PATIENCE_NS)
