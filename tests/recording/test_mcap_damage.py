"""A truncated or damaged recording yields all that is intact, and nothing else."""

from __future__ import annotations

import io
import struct
import tracemalloc
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import zstandard
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer
from mcap_rig import envelope, same, setup, writer_in

from protocol.errors import ConfigError
from protocol.wire import MAGIC as WIRE_MAGIC
from protocol.wire import PREFIX, VERSION, encode
from recording.mcap.reader import MAGIC, McapReader

pytest.importorskip("mcap", reason="needs the extra `mcap`")


TOPICS = ["tick", "scan", "detections", "lanes", "state", "request"]
MESSAGES = [envelope(topic, 1000 * n + k) for n in range(8) for k, topic in enumerate(TOPICS)]


def written() -> bytes:
    """Returns a recording of eight chunks."""
    with TemporaryDirectory() as folder:
        writer = writer_in(Path(folder))
        for n, item in enumerate(MESSAGES):
            writer.write(item)
            if n % len(TOPICS) == len(TOPICS) - 1:
                writer.settle(10**12 + item.received_ns)
        writer.close({})
        return (Path(folder) / "run.mcap").read_bytes()


WHOLE = written()


def ends_of(data: bytes) -> tuple[int, list[tuple[int, int]]]:
    """Returns where the setup ends, and for each chunk where it ends and how much it holds."""
    stream = io.BytesIO(data)
    setup_end, chunks = 0, []
    for record in StreamReader(stream, emit_chunks=True).records:
        if isinstance(record, Attachment):
            setup_end = stream.tell()
        elif isinstance(record, Chunk):
            held = sum(type(one).__name__ == "Message" for one in breakup_chunk(record))
            chunks.append((stream.tell(), held))
    return setup_end, chunks


SETUP_END, CHUNKS = ends_of(WHOLE)
EDGES = [end + step for end in (SETUP_END, *(end for end, _ in CHUNKS)) for step in (-1, 0, 1)]


def read(data: bytes) -> tuple[McapReader, list]:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cut.mcap"
        path.write_bytes(data)
        recording = McapReader(path)
        return recording, [*recording.messages()]


def check_cut(at: int) -> None:
    if at < SETUP_END:
        with pytest.raises(ConfigError, match=r"cut\.mcap"):
            read(WHOLE[:at])
        return
    recording, found = read(WHOLE[:at])
    assert same(found, MESSAGES[: sum(held for end, held in CHUNKS if end <= at)])
    assert recording.is_whole == (at == len(WHOLE))
    assert recording.drops.total() == 0
    assert encode(recording.setup) == encode(setup())


def test_the_example_has_a_chunk_for_each_second():
    assert [held for _, held in CHUNKS] == [len(TOPICS)] * 8


@pytest.mark.parametrize("at", [0, 1, 8, 9, *EDGES, len(WHOLE) - 1, len(WHOLE)])
def test_a_recording_cut_at_the_edge_of_a_chunk_gives_those_before(at):
    check_cut(at)


@given(st.integers(0, len(WHOLE)))
def test_a_recording_cut_anywhere_gives_all_complete_chunks(at):
    check_cut(at)


def test_a_file_that_had_no_time_to_begin_is_passed_over(tmp_path):
    for number, data in enumerate([b"", WHOLE, WHOLE[:5], WHOLE[: SETUP_END - 1], WHOLE], 1):
        (tmp_path / f"run-{number}.mcap").write_bytes(data)
    recording = McapReader(tmp_path)
    assert same(recording.messages(), MESSAGES + MESSAGES)
    assert encode(recording.setup) == encode(setup())
    assert not recording.is_whole


def test_a_damaged_chunk_alone_is_left_out():
    end = CHUNKS[3][0]
    recording, found = read(WHOLE[: end - 20] + bytes(20) + WHOLE[end:])
    lost = slice(3 * len(TOPICS), 4 * len(TOPICS))
    assert same(found, [item for item in MESSAGES if item not in MESSAGES[lost]])
    assert recording.drops == {"damaged": 1}
    assert not recording.is_whole


def test_a_bad_message_alone_is_left_out(tmp_path):
    good, bad = envelope("tick", 1), envelope("state", 2)
    bad.data = PREFIX.pack(WIRE_MAGIC, VERSION, bad.message.kind, 1, 0) + b"\x80"  # no field
    writer = writer_in(tmp_path)
    writer.write(good)
    writer.write(bad)
    writer.close({})
    recording = McapReader(tmp_path)
    assert same(recording.messages(), [good])
    assert recording.drops == {"MessageError": 1}


@settings(max_examples=200)
@given(st.binary(max_size=300), st.booleans())
@example(b"", True)
def test_garbage_is_no_recording(data, has_magic):
    with pytest.raises(ConfigError, match=r"cut\.mcap"):
        read(MAGIC * has_magic + data)


@settings(max_examples=200)
@given(st.lists(st.tuples(st.integers(8, len(WHOLE) - 1), st.integers(0, 255)), max_size=4))
def test_changed_bytes_never_give_what_was_not_heard(changes):
    data = bytearray(WHOLE)
    for at, value in changes:
        data[at] = value
    try:
        _, found = read(bytes(data))
    except ConfigError:
        return
    known = [item.data for item in MESSAGES]
    assert all(item.data in known for item in found)


def frame(opcode: Opcode, content: bytes, claimed: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if claimed is None else claimed) + content


def chunk(uncompressed: int, data: bytes, compression: bytes = b"zstd") -> bytes:
    head = struct.pack("<QQQI", 0, 0, uncompressed, 0)
    name = struct.pack("<I", len(compression)) + compression
    return frame(Opcode.CHUNK, head + name + struct.pack("<Q", len(data)) + data)


BOMB = zstandard.ZstdCompressor().compress(bytes(200 << 20))
BOMBS = {
    "a record longer than the file": frame(Opcode.CHUNK, b"", 1 << 40),
    "a record longer than any": frame(Opcode.CHUNK, b"", (1 << 64) - 1),
    "a chunk larger than any": chunk(1 << 40, b""),
    "a chunk that holds more than it says": chunk(1 << 20, BOMB),
    "a chunk that holds much": chunk(200 << 20, BOMB),
    "a chunk of odd compression": chunk(10, b"", b"brotli"),
    "a chunk of nothing": chunk(1 << 20, b""),
    "a chunk of text": chunk(1 << 20, b"once upon a time"),
    "a record in a chunk longer than it": chunk(9, frame(Opcode.MESSAGE, b"", 1 << 60), b""),
    "half a record in a chunk": chunk(3, b"abc", b""),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_takes_no_memory(name):
    data = WHOLE[: CHUNKS[0][0]] + BOMBS[name] + WHOLE[CHUNKS[0][0] :]
    tracemalloc.start()
    try:
        recording, found = read(data)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert same(found[: len(TOPICS)], MESSAGES[: len(TOPICS)])
    assert not recording.is_whole or recording.drops
    assert most < 80 << 20


def test_a_recording_whose_setup_is_bad_is_refused(tmp_path):
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        other = Writer(file, compression=CompressionType.ZSTD)
        other.start()
        other.add_attachment(0, 0, "setup.msgpack", "", encode(setup())[:-9])
        other.finish()
    with pytest.raises(ConfigError, match="the setup in it cannot be read: message has"):
        McapReader(tmp_path)


def test_a_file_of_another_system_is_refused(tmp_path):
    path = tmp_path / "ros.mcap"
    with path.open("wb") as file:
        other = Writer(file)
        other.start("ros2")
        other.finish()
    with pytest.raises(ConfigError, match="no recording of cpnet"):
        McapReader(path)


def test_what_is_no_recording_is_named(tmp_path):
    with pytest.raises(ConfigError, match="there is no such recording"):
        McapReader(tmp_path / "missing")
    with pytest.raises(ConfigError, match=r"no run\.mcap in it; `cpnet up --record`"):
        McapReader(tmp_path)
    (tmp_path / "record.mcap").write_bytes(b"text")
    with pytest.raises(ConfigError, match=r"There is record\.mcap: give the file"):
        McapReader(tmp_path)
    with pytest.raises(ConfigError, match="does not begin as an MCAP file"):
        McapReader(tmp_path / "record.mcap")
