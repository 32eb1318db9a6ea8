"""Small inputs that claim much: each is refused, or read, in little time and memory."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zstandard
from fuzz_targets import FILE_MIB, LIMIT_MS, MESSAGE_MIB, SCAN_MIB
from fuzz_watch import forget_peak, peak_kib

from protocol import messages as m
from protocol import wire
from protocol.codec import decode, encode_cloud, encode_scan
from protocol.codec.lattice import fill_nodes, sort_keys
from protocol.codec.octree import symbol_room, tree_to_symbols
from protocol.codec.payload import Form, Head, compress
from protocol.codec.rans import STATES, encode_symbols
from protocol.codec.symbols import LEVELS, shares_of_levels, write_tables
from protocol.codec.tree_contexts import CONTEXTS, STRIDE
from protocol.errors import CodecError, ConfigError, MessageError
from protocol.limits import MAX_BEAMS, MAX_POINTS
from protocol.scans import PointCloud, RangeScan, ScanPattern
from sensing.point_files import read_points
from sensing.recorded_scans import Recording

TRIES = 5
BASE = m.LaneCounts(
    frame=1, sim_time_ns=1, tls="J", agents=[], complete=True, upstream={}, downstream={}
).model_dump()


def cost(read: Callable[[], object]) -> tuple[float, float]:
    """Returns the least CPU time in ms and the most memory in MiB that reading took."""
    times, most_mib = [], 0.0
    for _ in range(TRIES):
        forget_peak()
        before_kib, begin_ns = peak_kib(), time.thread_time_ns()
        with suppress(MessageError, CodecError, ConfigError):
            read()
        times.append((time.thread_time_ns() - begin_ns) / 1e6)
        most_mib = max(most_mib, (peak_kib() - before_kib) / 1024)
    return min(times), most_mib


def frame_of(raw: bytes, *, claims: bool = True) -> bytes:
    parameters = zstandard.ZstdCompressionParameters.from_level(19, write_content_size=claims)
    return zstandard.ZstdCompressor(compression_params=parameters).compress(raw)


def deltas(points: int, frame: bytes) -> bytes:
    return Head(Form.DELTAS, points, 0.01).seal(frame)


def with_claim(frame: bytes, claim: int) -> bytes:
    """Gives a frame another content size, of eight bytes."""
    is_single = bool(frame[4] & 0b00100000)  # else a byte that tells the window
    size = (1 if is_single else 0, 2, 4, 8)[frame[4] >> 6]
    blocks = frame[5 + (not is_single) + size :]
    return frame[:4] + bytes([0b11100000]) + struct.pack("<Q", claim) + blocks


ZEROS = bytes(1 << 24)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (frame_of(ZEROS), "claims 16777216 bytes"),
        (frame_of(ZEROS, claims=False), "claims"),
        (frame_of(frame_of(ZEROS)), "claims"),
        (with_claim(frame_of(bytes(1 << 12)), 1 << 40), "claims 1099511627776 bytes"),
        (with_claim(frame_of(ZEROS), 120), "zstd"),
        (frame_of(bytes(120)) + frame_of(ZEROS), "zstd"),
        (b"\x50\x2a\x4d\x18" + struct.pack("<I", 120) + bytes(120), "zstd"),
    ],
    ids=["more", "unsaid", "nested", "a lie", "more than said", "two", "skipped"],
)
def test_a_frame_that_holds_more_than_the_scan_is_refused(frame: bytes, text: str):
    payload = deltas(10, frame)
    with pytest.raises(CodecError, match=text):
        decode(payload)
    took_ms, took_mib = cost(lambda: decode(payload))
    assert took_ms < LIMIT_MS
    assert took_mib < 8


@pytest.mark.parametrize("form", list(Form))
def test_points_and_beams_beyond_the_limits_are_refused_for_nothing(form: Form):
    for points, channels, columns in ((0xFFFFFFFF, 1, 1), (5, 65535, 0xFFFFFFFF), (5, 0, 9)):
        payload = Head(form, points, 0.01, channels, columns).seal(b"", b"", b"", b"")
        with pytest.raises(CodecError):
            decode(payload)
        assert cost(lambda payload=payload: decode(payload))[1] < 8


def scan_of(profile: str, channels: int, value: float) -> bytes:
    pattern = ScanPattern(channels, MAX_BEAMS // channels, 10.0, -30.0)
    shape = (channels, MAX_BEAMS // channels)
    scan = RangeScan(pattern, np.full(shape, value, np.float32), np.zeros(shape, np.float32))
    return encode_scan(scan, 0.02, profile=profile)


def cloud_of_one_place() -> bytes:
    points = np.zeros((MAX_POINTS, 3), np.float32)
    return encode_cloud(PointCloud(points, np.zeros(MAX_POINTS, np.float32)), 0.02)


LARGEST = {
    "deltas": lambda: deltas(MAX_POINTS, compress(np.zeros(12 * MAX_POINTS, np.uint8))),
    "tree": cloud_of_one_place,
    "planes": lambda: scan_of("fast", 1, 10.0),
    "image": lambda: scan_of("default", 64, 10.0),
    "image of one ring": lambda: scan_of("default", 1, 10.0),
}


@pytest.mark.parametrize("name", LARGEST)
def test_the_most_that_a_small_payload_can_hold_is_soon_read(name: str):
    payload = LARGEST[name]()
    assert len(payload) < 1 << 20
    assert len(decode(payload).points) in (MAX_BEAMS, MAX_POINTS)
    took_ms, took_mib = cost(lambda: decode(payload))
    assert took_ms < LIMIT_MS
    assert took_mib < SCAN_MIB


def certain_tree(side: int) -> bytes:
    """Pairs of points on a coarse grid within a fine tree, every symbol as good as certain."""
    places = np.arange(side) << 13
    grid = np.stack(np.meshgrid(places, places, places, indexing="ij"), -1).reshape(-1, 3)
    points, cells = np.repeat(grid, 2, axis=0).astype(np.float64), np.empty((2 * side**3, 3), int)
    keys, order = np.empty(len(cells), np.uint64), np.empty(len(cells), np.int64)
    fill_nodes(points, np.zeros(3), 1.0, cells, keys)
    sort_keys(keys, 61, order)
    symbols = np.empty(symbol_room(len(keys), 20), np.uint32)
    raw, sizes = np.empty(2 * len(keys) + 2, np.uint32), np.zeros(2, np.int64)
    counts = np.zeros((CONTEXTS, STRIDE), np.int64)
    tree_to_symbols(keys, cells[order], 20, symbols, raw, counts, np.empty_like(order), sizes)
    used = np.flatnonzero(counts.any(axis=1))  # each with a table of its own, up to the next
    table_of = (np.searchsorted(used, np.arange(CONTEXTS), "right") - 1).clip(0).astype(np.uint8)
    levels = np.where(counts[used] > 0, 1, 0).astype(np.uint8)
    levels[np.arange(len(used)), counts[used].argmax(axis=1)] = LEVELS - 1
    shares, written = np.zeros(levels.shape, np.uint16), np.zeros(1 << 14, np.uint8)
    length = write_tables(table_of, levels, len(used), written)
    shares_of_levels(levels, len(used), shares)
    words = np.empty(int(sizes[0]) + 2 * STATES, np.uint16)
    first = encode_symbols(symbols, int(sizes[0]), shares[table_of], words)
    head = struct.pack("<dddB", 0.0, 0.0, 0.0, 20)
    parts = (head, written[:length].tobytes(), words[first:].tobytes(), raw[: sizes[1]].tobytes())
    return Head(Form.TREE, len(keys), 0.01).seal(*parts)


def test_a_tree_of_millions_of_certain_symbols_is_given_up():
    few, many = certain_tree(16), certain_tree(64)
    assert len(decode(few).points) == 2 * 16**3
    assert len(many) < 1 << 17
    with pytest.raises(CodecError, match="damaged"):
        decode(many)
    took_ms, took_mib = cost(lambda: decode(many))
    assert took_ms < LIMIT_MS
    assert took_mib < SCAN_MIB


@pytest.mark.parametrize("side", [8, 40])
def test_an_encoder_makes_no_tree_that_a_decoder_gives_up(side: int):
    places = np.arange(side) * 2.0**7
    grid = np.stack(np.meshgrid(places, places, places, indexing="ij"), -1).reshape(-1, 3)
    points = np.repeat(grid, 2, axis=0).astype(np.float32)
    cloud = PointCloud(points, np.zeros(len(points), np.float32))
    assert len(decode(encode_cloud(cloud, 0.0135)).points) == len(points)


def packed(kind: type[m.Message], header: bytes) -> bytes:
    return wire.PREFIX.pack(wire.MAGIC, wire.VERSION, kind.kind, len(header), 0) + header


MESSAGES = {
    "lists": (m.Roster, msgpack.packb({"agents": [[]] * 250_000})),
    "lists within lists": (m.Roster, msgpack.packb({"agents": [[[]] * 60_000] * 4})),
    "a deep list": (m.Roster, b"\x81\xa1a" + b"\x91" * 250_000 + b"\x90"),
    "maps": (m.Metrics, msgpack.packb({"spans": [{}] * 250_000})),
    "bad spans": (m.Metrics, msgpack.packb({"spans": [{"a": 1}] * 60_000})),
    "bad counts": (
        m.LaneCounts,
        msgpack.packb(BASE | {"upstream": {str(n): -1 for n in range(30_000)}}),
    ),
    "many counts": (
        m.LaneCounts,
        msgpack.packb(BASE | {"upstream": {str(n): 1 for n in range(30_000)}}),
    ),
    "extensions": (m.End, b"\x81\xa1a\xdc\xff\xff" + b"\xd4\x05\x00" * 65_535),
    "times": (m.End, b"\x81\xa1a\xdc\x99\x99" + b"\xd6\xff\x00\x00\x00\x01" * 0x9999),
    "a list that claims more": (m.End, b"\x81\xa1a\xdd\xff\xff\xff\xff"),
    "a text that claims more": (m.End, b"\x81\xa1a\xdb\xff\xff\xff\xff"),
}


@pytest.mark.parametrize("name", MESSAGES)
def test_a_header_full_of_nothing_is_soon_refused(name: str):
    kind, header = MESSAGES[name]
    assert len(header) <= kind.max_header_bytes
    data = packed(kind, header)
    with pytest.raises(MessageError):
        wire.decode(data, kind)
    took_ms, took_mib = cost(lambda: wire.decode(data, kind))
    assert took_ms < LIMIT_MS
    assert took_mib < MESSAGE_MIB


@pytest.mark.parametrize("field", ["vehicle_types", "polygons", "meshes", "scenario"])
def test_a_setup_full_of_errors_costs_one(field: str):
    """Only the world's host publishes one, once; it is as large as allowed."""
    count = 1_900_000
    wrong: object = [1] * (7 * count)
    if field == "scenario":
        wrong = {bytes([0xFF]) + n.to_bytes(3, "big"): 1 for n in range(count)}
    fields = {"scenario": {}, "mesh_vertices": [0, 3], "mesh_triangles": [0, 3]}
    data = packed(m.Setup, msgpack.packb(fields | {field: wrong}))
    assert 12 << 20 < len(data) < 16 << 20
    forget_peak()
    before_kib, begin_ns = peak_kib(), time.thread_time_ns()
    with pytest.raises(MessageError, match="Setup"):
        wire.decode(data, m.Setup)
    assert time.thread_time_ns() - begin_ns < 10e9
    assert peak_kib() - before_kib < 512 << 10


HEADER = (
    "FIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\nPOINTS {points}\nDATA {kind}\n"
)


def pcd(kind: str, points: int, body: bytes, fields: int = 0, counts: str = "1") -> bytes:
    more = ["abcdefghij"[n % 10] for n in range(fields)]
    text = HEADER.format(
        fields=" ".join(["x", "y", "z", *more]),
        sizes=" ".join(["4"] * 3 + ["1"] * fields),
        types=" ".join(["F"] * 3 + ["U"] * fields),
        counts=" ".join(["1"] * 3 + [counts] * fields),
        points=points,
        kind=kind,
    )
    return text.encode() + body


LZF_BOMB = b"\x00A" + b"\xe0\xff\x00" * 20_000
FILES = {
    "many fields": pcd("ascii", 0, b"", fields=8000),
    "a wide field": pcd("binary", 1, bytes(64), fields=1, counts="9" * 4000),
    "more points than bytes": pcd("binary", 10**18, bytes(64)),
    "points of nothing": pcd("ascii", 10**18, b""),
    "compressed to more": pcd(
        "binary_compressed", 10, struct.pack("<II", len(LZF_BOMB), 120) + LZF_BOMB
    ),
    "compressed as claimed": pcd(
        "binary_compressed",
        (1 + 264 * 20_000) // 12,
        struct.pack("<II", len(LZF_BOMB), (1 + 264 * 20_000) // 12 * 12) + LZF_BOMB,
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_a_cloud_file_that_claims_much_is_soon_read_or_refused(name: str, tmp_path: Path):
    path = tmp_path / "bomb.pcd"
    path.write_bytes(FILES[name])
    assert len(FILES[name]) < 1 << 17
    took_ms, took_mib = cost(lambda: read_points(path))
    assert took_ms < LIMIT_MS
    assert took_mib < FILE_MIB


def test_a_recording_that_claims_more_than_its_file_is_refused(tmp_path: Path):
    header = "{'descr': '<u2', 'fortran_order': False, 'shape': (1099511627776, 1, 4, 8), }"
    text = header.ljust(117) + "\n"
    (tmp_path / "ranges.npy").write_bytes(
        b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()
    )
    (tmp_path / "recording.json").write_text(
        '{"agents": ["a"], "frame_period_s": 0.1, "pattern": {"channels": 4, "columns": 8,'
        ' "upper_fov_deg": 2, "lower_fov_deg": -2}}'
    )
    (tmp_path / "truth.bin").write_bytes(b"")
    with pytest.raises(ConfigError):
        Recording(tmp_path)
    assert cost(lambda: Recording(tmp_path))[1] < 8
