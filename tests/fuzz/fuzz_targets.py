"""Fuzz targets: all readers of untrusted bytes or text, with allowed errors and limits."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from fuzz_mutate import (
    Mutator,
    shake,
    shake_message,
    shake_parts,
    shake_scan,
    shake_scan_message,
    shake_text,
    split_parts,
)

from edge_server.frame import Chunk
from edge_server.placing import Decode
from protocol.bus import Endpoint
from protocol.clock import Exchange, OffsetFilter
from protocol.codec import decode as decode_scan
from protocol.codec.payload import Form
from protocol.errors import BusError, CodecError, ConfigError, CpnetError, ProtocolError
from protocol.inbox import Envelope, Inbox, Presence, RawMessage
from protocol.limits import MAX_BODY_BYTES, MAX_POINTS
from protocol.messages import MESSAGES, ClockReading, Message, Scan, TimeReply
from protocol.topics import TOPICS, Topic, alive_parts
from protocol.wire import decode, encode, peek_frame_time
from sensing.link_config import read_trace
from sensing.pcd import decompress
from sensing.point_files import read_points
from sensing.recorded_scans import Recording

HERE = Path(__file__).parent
GOLDEN = HERE.parent / "protocol" / "golden"
MAX_INPUT_BYTES = 1 << 16
LIMIT_MS = 100  # of CPU time, for one input
HANG_S = 20  # of wall time; then it counts as hanging
# A header's lists and maps, as Python holds them, and a body.
MESSAGE_MIB = 64
# A payload; of each point that it may claim the coordinates as float64, twice, its cell, its key,
# the result and its intensity.
SCAN_MIB = (MAX_BODY_BYTES + MAX_POINTS * (24 + 24 + 24 + 8 + 12 + 4)) >> 20
FILE_MIB = 64
# A chunk unpacked, and its messages.
RECORDING_MIB = 4 * MAX_BODY_BYTES >> 20

_SCRATCH = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A reader: `read` takes an input and raises `allowed` if that is not what it should be.

    `most_mib` is the most memory that one input may take. `compiled` readers have loops in which
    nothing checks an index unless they are compiled so. `weight` is the share of messages.
    """

    name: str
    read: Callable[[bytes], None]
    allowed: tuple[type[CpnetError | ValueError], ...]
    mutate: Mutator
    most_mib: int
    compiled: bool = False
    weight: float = 1.0

    def seeds(self) -> list[bytes]:
        """Returns the inputs that are kept for it: good ones, and those that were found."""
        kept = sorted((HERE / "seeds" / self.name).glob("*"))
        golden = GOLDEN / f"{self.name.removeprefix('message-')}.bin"
        return [path.read_bytes() for path in [*kept, golden] if path.is_file()]

    def takes(self, data: bytes) -> bool:
        """Reads an input; returns whether it was good, and raises what nothing should raise."""
        try:
            self.read(data)
        except self.allowed:
            return False
        return True


def _through_inbox(topic: Topic) -> Callable[[bytes], None]:
    inbox = Inbox()
    key = topic.key(**dict.fromkeys(_parts(topic), "a"))

    def read(data: bytes) -> None:
        with suppress(ProtocolError):  # a recording asks for no more
            peek_frame_time(data, topic.message)
        inbox.put(RawMessage(topic, key, data, 0))
        item = inbox.get()
        if item is None:
            raise ProtocolError("counted and dropped")
        assert isinstance(item, Envelope)
        encode(item.message)

    return read


def _parts(topic: Topic) -> list[str]:
    return [part[1:-1] for part in topic.template.split("/") if part.startswith("{")]


def _read_scan(data: bytes) -> None:
    cloud = decode_scan(data)
    assert len(cloud.points) == len(cloud.intensity) <= MAX_POINTS
    assert np.isfinite(cloud.points).all()


def _read_scan_message(data: bytes) -> None:
    chunk = Decode().run(Chunk.of(decode(data, Scan), 0))
    assert chunk.returns == len(chunk.points)


def _read_key(data: bytes) -> None:
    """The first byte chooses a topic, the rest is the key at which a good message came."""
    text = data.decode("utf-8", "surrogateescape")
    topics = list(TOPICS.values())
    topic = topics[data[0] % len(topics)] if data else topics[0]
    inbox = Inbox()
    inbox.put(RawMessage(topic, text[1:], _EXAMPLES[topic.message], 0))
    if inbox.get() is None:
        raise ProtocolError("counted and dropped")


def _read_alive_key(data: bytes) -> None:
    role, process = alive_parts(data.decode("utf-8", "surrogateescape"))
    inbox = Inbox()
    inbox.put(Presence(role, process, alive=True))
    assert inbox.get() == Presence(role, process, alive=True)


def _read_endpoint(data: bytes) -> None:
    Endpoint.parse(data.decode("utf-8", "surrogateescape"))


def _read_time(data: bytes) -> None:
    reply = decode(data, TimeReply)
    offsets = OffsetFilter()
    offsets.add(Exchange(1_000, reply.received_ns, reply.replied_ns, 2_000))
    if found := offsets.best(3_000):
        ClockReading(process="a", offset_ns=found[0], error_ns=found[1])


def _work_inbox(data: bytes) -> None:
    """Pairs of bytes put messages of few keys into a small inbox, or take them out."""
    inbox = Inbox(capacity=8, max_bytes=4096)
    inbox.limit("roster", 2)
    held = 0
    data = data[:512]
    for what, which in zip(data[::2], data[1::2], strict=False):
        topic = TOPICS[("roster", "pose")[which & 1]]
        if what % 4 == 0:
            inbox.get()
        elif what % 4 == 1:
            inbox.put(Presence("edge", str(which), alive=True))
        elif what % 4 == 2:
            inbox.put(RawMessage(topic, f"cpnet/v4/r/roster/{which >> 6}", bytes(which * 8), 0))
        else:
            inbox.wake()
    while inbox.get() is not None or inbox._queue.qsize():
        held += 1
    assert held <= 16
    assert inbox._bytes == 0
    assert not inbox._waiting


def _from_file(suffix: str, read: Callable[[Path], object]) -> Callable[[bytes], None]:
    def through(data: bytes) -> None:
        with tempfile.NamedTemporaryFile(dir=_SCRATCH, suffix=suffix, buffering=0) as file:
            file.write(data)
            read(Path(file.name))

    return through


def _read_lzf(data: bytes) -> None:
    decompress(data[2:], int.from_bytes(data[:2], "little"))


def _read_recording(data: bytes) -> None:
    """Three parts, each behind its length: about, ranges and truth."""
    with tempfile.TemporaryDirectory(dir=_SCRATCH) as folder:
        names = ("recording.json", "ranges.npy", "truth.bin")
        for name, part in zip(names, split_parts(data, 3), strict=True):
            (Path(folder) / name).write_bytes(part)
        recording = Recording(Path(folder))
        recording.scan(recording.agents[0], 1)


def _read_mcap(path: Path) -> None:
    from recording.mcap.reader import McapReader

    recording = McapReader(path)
    for item in recording.messages():
        encode(item.message)
    assert not recording.is_whole or not recording.drops["damaged"]


def _message_target(message: type[Message]) -> Target:
    topic = next(topic for topic in TOPICS.values() if topic.message is message)
    name = f"message-{message.__name__}"
    return Target(name, _through_inbox(topic), (ProtocolError,), shake_message, MESSAGE_MIB)


def _scan_target(form: Form) -> Target:
    name = f"scan-{form.name.lower()}"
    return Target(name, _read_scan, (CodecError,), shake_scan, SCAN_MIB, compiled=True, weight=2)


_EXAMPLES: dict[type[Message], bytes] = {
    kind: (GOLDEN / f"{kind.__name__}.bin").read_bytes() for kind in MESSAGES.values()
}
_text = partial(shake_text, [b"cpnet/v4/", b"world/", b"roster/", b"alive/", b"/", b"*", b"%2F"])
_locator = partial(shake_text, [b"listen:", b"connect:", b"tcp/", b"127.0.0.1:7447", b"[::1]:"])
_header = partial(
    shake_text,
    [b"FIELDS x y z", b"COUNT", b"SIZE", b"TYPE", b"POINTS", b"DATA ascii", b"DATA binary", b"\n"],
)
_table = partial(
    shake_text, [b"time_s", b"rate_mbps", b"rtt_ms", b",", b"\n", b'"', b"nan", b"9e9"]
)

TARGETS = {
    target.name: target
    for target in (
        *(_message_target(message) for message in MESSAGES.values()),
        Target("key", _read_key, (ProtocolError,), _text, MESSAGE_MIB),
        Target("alive-key", _read_alive_key, (ProtocolError,), _text, MESSAGE_MIB),
        Target("endpoint", _read_endpoint, (BusError,), _locator, MESSAGE_MIB),
        Target("time-reply", _read_time, (ProtocolError,), shake_message, MESSAGE_MIB),
        Target("inbox", _work_inbox, (), shake, MESSAGE_MIB, weight=0.5),
        *(_scan_target(form) for form in Form),
        Target(
            "scan-message",
            _read_scan_message,
            (ProtocolError,),
            shake_scan_message,
            MESSAGE_MIB + SCAN_MIB,
            compiled=True,
        ),
        Target("pcd", _from_file(".pcd", read_points), (ConfigError,), _header, FILE_MIB),
        Target("ply", _from_file(".ply", read_points), (ConfigError,), _header, FILE_MIB),
        Target("npy", _from_file(".npy", read_points), (ConfigError,), shake, FILE_MIB, weight=0.5),
        Target("bin", _from_file(".bin", read_points), (ConfigError,), shake, FILE_MIB, weight=0.5),
        Target("lzf", _read_lzf, (ValueError,), shake, FILE_MIB),
        Target("trace-csv", _from_file(".csv", read_trace), (ConfigError,), _table, FILE_MIB),
        Target("trace-mahimahi", _from_file(".up", read_trace), (ConfigError,), shake, FILE_MIB),
        *(
            [
                Target(
                    "mcap",
                    _from_file(".mcap", _read_mcap),
                    (ConfigError,),
                    shake,
                    RECORDING_MIB,
                )
            ]
            if find_spec("mcap")  # the extra `mcap`
            else []
        ),
        Target("recording", _read_recording, (ConfigError,), shake_parts, FILE_MIB, weight=0.25),
    )
}
"""All targets by name."""
