"""What is written to a recording is what is read from it."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_rig import envelope, recorded_messages, same, setup, writer_in

from protocol.errors import ConfigError, CpnetError
from protocol.messages import MESSAGES
from protocol.observer import ALL_TOPICS
from protocol.topics import TOPICS
from protocol.wire import array_fields, encode
from recording.mcap import writer as writer_module
from recording.mcap.format import files_in, next_file, schema_of
from recording.mcap.reader import McapReader
from recording.mcap.writer import McapWriter

pytest.importorskip("mcap", reason="needs the extra `mcap`")


@settings(max_examples=50)
@given(recorded_messages(), st.sets(st.sampled_from(sorted(ALL_TOPICS))))
def test_all_that_was_heard_comes_back_as_it_came(recorded, wanted):
    with TemporaryDirectory() as folder:
        writer = writer_in(Path(folder))
        for item in recorded:
            writer.write(item)
            writer.settle(item.received_ns)
        writer.close({})
        recording = McapReader(Path(folder))
        assert same(recording.messages(), recorded)
        assert same(recording.messages(wanted), [item for item in recorded if item.topic in wanted])
        assert encode(recording.setup) == encode(setup())
        assert (recording.is_whole, recording.drops.total()) == (True, 0)
        assert recording.facts == {"name": "a test"}


def test_a_recording_that_could_not_go_on_says_why_and_can_be_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "MAX_CHUNKS", 0)
    paths = iter([tmp_path / "run.mcap", tmp_path / "gone" / "run-2.mcap"])
    writer = McapWriter(lambda: next(paths), setup(), {})
    writer.write(envelope("tick", 1))
    with pytest.raises(ConfigError, match=r"run-2\.mcap cannot be written"):
        writer.settle(2)
    writer.close({})
    assert [item.topic for item in McapReader(tmp_path).messages()] == ["tick"]


def test_other_readers_find_their_way(tmp_path):
    recorded = [envelope(topic, 100 + n) for n, topic in enumerate(sorted(ALL_TOPICS))]
    writer = writer_in(tmp_path)
    for item in recorded:
        writer.write(item)
    writer.close({"drops": "{}"})
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert len(summary.channels) == summary.statistics.message_count == len(recorded)
        assert [index.compression for index in summary.chunk_indexes] == ["zstd"]
        assert [one.name for one in reader.iter_attachments()] == ["setup.msgpack"]
        assert [one.name for one in reader.iter_metadata()] == ["cpnet", "cpnet.closing"]
        for schema, channel, message in reader.iter_messages():
            topic = TOPICS[channel.metadata["topic"]]
            assert schema.name == f"cpnet.{topic.message.__name__}"
            assert channel.topic == topic.key(**topic.parts(channel.topic))
            assert (channel.message_encoding, message.sequence) == ("cpnet", 0)
            assert channel.metadata["bus"] == topic.bus.value


def test_the_world_is_on_a_channel_set_of_its_own():
    apart = {name for name, topic in TOPICS.items() if topic.bus.value == "world"}
    keys = {name: TOPICS[name].key() for name in apart}
    assert all("/world/" in key or "/metrics/" in key for key in keys.values())


def test_published_is_when_it_was_in_the_world(tmp_path):
    writer = writer_in(tmp_path)
    pose, roster = envelope("pose", 1000), envelope("roster", 2000)
    writer.write(pose)
    writer.write(roster)
    writer.close({})
    with (tmp_path / "run.mcap").open("rb") as file:
        found = [(m.log_time, m.publish_time) for _, _, m in make_reader(file).iter_messages()]
    assert found == [(1000, pose.message.sim_time_ns), (2000, 2000)]


def test_times_never_run_backwards(tmp_path):
    writer = writer_in(tmp_path)
    for time_ns in (50, 40, 60):
        writer.write(envelope("tick", time_ns))
    writer.close({})
    assert [item.received_ns for item in McapReader(tmp_path).messages()] == [50, 50, 60]


def test_what_is_a_second_old_is_in_the_file(tmp_path):
    writer = writer_in(tmp_path)
    item = envelope("tick", 10_000_000_000)
    writer.write(item)
    writer.settle(item.received_ns + writer_module.CHUNK_NS - 1)
    assert not [*McapReader(tmp_path).messages()]
    writer.settle(item.received_ns + writer_module.CHUNK_NS)
    recording = McapReader(tmp_path)
    assert same(recording.messages(), [item])
    assert not recording.is_whole
    writer.close({})


def test_what_is_much_is_in_the_file_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "CHUNK_BYTES", 1000)
    writer = writer_in(tmp_path)
    items = [envelope("scan", n) for n in range(100)]
    for item in items:
        writer.write(item)
    found = [*McapReader(tmp_path).messages()]
    assert same(found, items[: len(found)])
    assert (len(items) - len(found)) * len(items[0].data) < 1000
    writer.close({})


def test_a_recording_that_is_started_again_leaves_the_first_alone(tmp_path):
    first, second = writer_in(tmp_path), writer_in(tmp_path)
    first.write(envelope("tick", 1))
    second.write(envelope("tick", 2))
    for writer in (first, second):
        writer.close({})
    assert [path.name for path in files_in(tmp_path)] == ["run.mcap", "run-2.mcap"]
    assert [item.received_ns for item in McapReader(tmp_path).messages()] == [1, 2]
    assert [item.received_ns for item in McapReader(tmp_path / "run-2.mcap").messages()] == [2]


def test_a_long_recording_goes_on_in_another_file(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "MAX_CHANNELS", 3)
    recorded = [envelope("pose", n, f"agent {n % 7}") for n in range(40)]
    writer = writer_in(tmp_path)
    for item in recorded:
        writer.write(item)
        writer.settle(0)
    writer.close({})
    assert writer.files == files_in(tmp_path)
    assert len(writer.files) > 5
    assert writer.size_bytes == sum(path.stat().st_size for path in writer.files)
    recording = McapReader(tmp_path)
    assert recording.is_whole
    assert same(recording.messages(), recorded)
    assert same(McapReader(writer.files[0]).messages(), recorded)
    writer_in(tmp_path).close({})  # another recording
    assert McapReader(writer.files[0]).files == writer.files
    for path in writer.files:  # each can be opened alone
        assert encode(McapReader(path).setup) == encode(setup())


def test_files_are_read_in_the_order_of_their_numbers(tmp_path):
    names = ["run.mcap", "run-2.mcap", "run-10.mcap"]
    for name in [*reversed(names), "run-x.mcap", "run-1.mcap.bak", "record.mcap", "run-02.mcap"]:
        (tmp_path / name).touch()
    assert [path.name for path in files_in(tmp_path)] == names
    assert next_file(tmp_path).name == "run-11.mcap"
    assert next_file(tmp_path, "record").name == "record-2.mcap"


def test_a_file_that_is_there_is_not_written_over(tmp_path):
    path = tmp_path / "mine.mcap"
    path.write_bytes(b"dear to me")
    with pytest.raises(ConfigError, match="mine.mcap cannot be written: File exists"):
        McapWriter(lambda: path, setup(), {})
    assert path.read_bytes() == b"dear to me"


def test_a_full_disk_ends_a_recording_by_name(tmp_path, monkeypatch):
    writer = writer_in(tmp_path)
    writer.write(envelope("tick", 1))

    def fail(_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer_module.Writer, "flush", fail)
    with pytest.raises(CpnetError, match=r"run\.mcap cannot be written: No space left"):
        writer.settle(10**12)
    writer.close({})  # and does not fail again
    assert not McapReader(tmp_path).is_whole


@pytest.mark.parametrize("message", MESSAGES.values(), ids=lambda message: message.__name__)
def test_every_message_has_a_schema_of_its_fields(message):
    schema = json.loads(schema_of(message))
    assert schema["properties"].keys() == message.model_fields.keys()
    for name in array_fields(message):
        assert "in the body" in schema["properties"][name]["description"]
