import struct
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import messages as m
from protocol import wire
from protocol.errors import MessageError, ProtocolError, VersionError
from tests.messages import EXAMPLES, SCAN

GOLDEN = Path(__file__).parent / "golden"


def as_data(message: m.Message) -> dict:
    data = message.model_dump()
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in data.items()}


def test_there_is_an_example_of_every_message():
    assert [type(example) for example in EXAMPLES] == list(m.MESSAGES.values())


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda e: type(e).__name__)
def test_a_message_comes_back_as_it_was(message):
    assert as_data(wire.decode(wire.encode(message), type(message))) == as_data(message)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda e: type(e).__name__)
def test_the_moment_of_a_message_can_be_read_alone(message):
    moment = getattr(message, "frame", None), getattr(message, "sim_time_ns", None)
    assert wire.peek_frame_time(wire.encode(message), type(message)) == moment


@given(st.binary(max_size=300), st.sampled_from(list(m.MESSAGES.values())))
def test_a_moment_is_read_from_any_header_or_one_kind_of_error_raised(header, expected):
    prefix = wire.PREFIX.pack(wire.MAGIC, wire.VERSION, expected.kind, len(header), 0)
    try:
        found = wire.peek_frame_time(prefix + header, expected)
    except MessageError:
        return
    assert all(value is None or type(value) is int for value in found)


@pytest.mark.parametrize("odd", [1.5, None, "now", [1]])
def test_a_time_that_is_no_integer_is_none(odd):
    data = packed(m.Tick, {"frame": 1, "sim_time_ns": odd})
    assert wire.peek_frame_time(data, m.Tick) == (1, None)


def test_a_time_that_takes_too_much_room_is_refused():
    with pytest.raises(MessageError, match="header"):
        wire.peek_frame_time(packed(m.Tick, {"sim_time_ns": [[]] * 20_000}), m.Tick)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda e: type(e).__name__)
def test_the_bytes_of_a_message_are_those_of_version_4(message):
    golden = (GOLDEN / f"{type(message).__name__}.bin").read_bytes()
    assert wire.encode(message) == golden


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda e: type(e).__name__)
def test_a_message_cut_anywhere_raises_a_message_error(message):
    data = wire.encode(message)
    for cut in {*range(0, len(data), max(1, len(data) // 60)), len(data) - 1}:
        with pytest.raises(MessageError):
            wire.decode(data[:cut], type(message))


@given(st.binary(max_size=300), st.sampled_from(list(m.MESSAGES.values())))
def test_random_bytes_raise_one_kind_of_error(data, expected):
    with pytest.raises(ProtocolError):
        wire.decode(data, expected)


@settings(max_examples=400)
@given(st.data())
def test_a_damaged_message_decodes_or_raises_one_kind_of_error(data):
    message = data.draw(st.sampled_from(EXAMPLES))
    damaged = bytearray(wire.encode(message))
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    try:
        wire.decode(bytes(damaged), type(message))
    except ProtocolError:
        return


def test_another_version_is_refused_with_both_named():
    data = bytearray(wire.encode(SCAN))
    struct.pack_into("<H", data, 4, 9)
    with pytest.raises(VersionError, match="version 9, this side 4"):
        wire.decode(bytes(data), m.Scan)


def test_a_length_over_the_limit_is_refused_with_the_numbers():
    head = wire.PREFIX.pack(wire.MAGIC, wire.VERSION, m.Scan.kind, 100, 1 << 30)
    with pytest.raises(MessageError, match="body has length 1073741824, limit 16777216"):
        wire.decode(head, m.Scan)


def test_an_oversized_message_is_not_even_sent():
    big = SCAN.model_copy(update={"payload": np.zeros(wire.MAX_BODY_BYTES + 1, np.uint8)})
    with pytest.raises(MessageError, match="limit"):
        wire.encode(big)


def test_a_message_on_the_wrong_topic_is_named():
    with pytest.raises(MessageError, match="message is Scan, this topic carries Tick"):
        wire.decode(wire.encode(SCAN), m.Tick)


def test_unknown_fields_are_tolerated():
    message = m.End(frames=1, reason="finished")
    header = msgpack.packb({**message.model_dump(), "colour": "red"})
    data = wire.PREFIX.pack(wire.MAGIC, wire.VERSION, message.kind, len(header), 0) + header
    assert wire.decode(data, m.End) == message


def test_a_pose_that_is_not_finite_is_refused():
    data = wire.encode(SCAN)
    nan = struct.pack("<d", float("nan"))
    damaged = data.replace(struct.pack("<d", 5.0), nan)
    with pytest.raises(MessageError, match="not finite"):
        wire.decode(damaged, m.Scan)


@pytest.mark.parametrize("shape", [[2**40], [-1], [3, 3], "many", [1.5], [True]])
def test_an_array_that_lies_about_its_shape_is_refused(shape):
    fields = SCAN.model_dump(exclude={"payload"}) | {"payload": shape, "sensor_pose": [6]}
    header = msgpack.packb(fields)
    body = SCAN.sensor_pose.tobytes()
    data = (
        wire.PREFIX.pack(wire.MAGIC, wire.VERSION, m.Scan.kind, len(header), len(body))
        + header
        + body
    )
    with pytest.raises(MessageError):
        wire.decode(data, m.Scan)


def test_decoded_arrays_cannot_be_changed():
    back = wire.decode(wire.encode(SCAN), m.Scan)
    with pytest.raises(ValueError, match="read-only"):
        back.payload[0] = 1


def packed(kind: type[m.Message], header: dict, body: bytes = b"") -> bytes:
    data = msgpack.packb(header)
    return wire.PREFIX.pack(wire.MAGIC, wire.VERSION, kind.kind, len(data), len(body)) + data + body


@pytest.mark.parametrize(
    ("example", "changes"),
    [
        (m.Roster, {"frame": 1 << 40}),
        (m.Roster, {"frame": -1}),
        (m.Roster, {"process": ""}),
        (m.Roster, {"process": "x" * 129}),
        (m.Roster, {"agents": ["a"] * 4097}),
        (m.SignalState, {"sim_time_ns": 1 << 62}),
        (m.SignalRequest, {"policy": "x" * 513}),
        (m.SignalRequest, {"pressures": [float("nan")]}),
        (m.Progress, {"real_time_factor": float("inf")}),
        (m.Progress, {"state": "\x1b[2J\x1b]0;owned\x07RED"}),
        (m.Progress, {"state": "Gx"}),
        (m.Progress, {"mbps": {"\x1b[2J": 1.0}}),
        (m.SignalState, {"state": "G\n"}),
        (m.SignalState, {"tls": "J\x9b2J"}),
        (m.SignalState, {"source": "plan\n"}),
        (m.SignalRequest, {"policy": "a\x7f"}),
        (m.SignalRequest, {"advised": 4097}),
        (m.SpeedAdvice, {"speed_mps": 0.0}),
        (m.SpeedAdvice, {"speed_mps": 200.1}),
        (m.SpeedAdvice, {"speed_mps": float("nan")}),
        (m.SpeedAdvice, {"speed_mps": "free"}),
        (m.SpeedAdvice, {"agent": "a\0"}),
        (m.Roster, {"agents": ["a\0"]}),
        (m.End, {"reason": "\x1b]0;owned\x07"}),
        (m.Metrics, {"drops": {"late": 1 << 53}}),
        (m.Metrics, {"spans": [{"stage": "x", "start_ns": 1 << 63, "end_ns": 0}]}),
        (m.LaneCounts, {"upstream": {"a": -1}}),
        (m.Trips, {"trips": [{"vehicle": "a", "equipment": 0, "depart_s": float("nan"),
                              "arrive_s": None, "time_loss_s": 0.0}]}),
    ],
)  # fmt: skip
def test_what_is_out_of_bounds_is_refused(example: type[m.Message], changes: dict):
    (message,) = (e for e in EXAMPLES if type(e) is example)
    with pytest.raises(MessageError, match=f"{example.__name__}.{next(iter(changes))}"):
        wire.decode(packed(example, message.model_dump() | changes), example)


@pytest.mark.parametrize(
    ("example", "changes", "text"),
    [
        (m.Tick, {"agents": ["a"]}, "lists have lengths"),
        (m.Tick, {"agents": ["a", "a"]}, "twice"),
        (m.Tick, {"since": np.zeros(2, np.int64)}, "lists have lengths"),
        (m.Tick, {"hosts": np.array([0, 1], np.int32)}, "a host is none of the 1 processes"),
        (m.Tick, {"equipment": np.array([0, 3], np.uint8)}, "equipment 3"),
        (m.Tick, {"places": np.full((2, 2), 2e7)}, "1e7 m"),
        (m.TileBodies, {"types": ["car"]}, "lists have lengths"),
        (m.TileRequest, {"tiles": np.zeros((4097, 2), np.int32)}, "4097 tiles, limit 4096"),
        (m.TileBodies, {"ids": ["a", "a"]}, "twice"),
        (m.TileBodies, {"poses": np.full((2, 6), 2e7)}, "1e7 m"),
        (m.Truth, {"lanes": []}, "lists have lengths"),
        (m.Detections, {"sources": []}, "lists have lengths"),
        (m.AgentPose, {"pose": np.full(6, 1e4)}, "1e3 rad"),
        (m.AgentPose, {"position_std_m": 1001.0}, "position_std_m"),
        (m.AgentPose, {"agent": "a\r"}, "AgentPose.agent"),
        (m.AgentPose, {"agent": "é" * 65}, "more than 128 bytes"),
        (m.Objects, {"boxes": np.full((1, 7), 2e7, np.float32)}, "beyond 1e7"),
        (m.Objects, {"boxes": np.ones((4097, 7), np.float32)}, "4097 boxes, limit 4096"),
        (m.Scan, {"chunk": 1}, "chunk 1 of 1"),
    ],
)
def test_a_message_that_contradicts_itself_is_refused(example, changes: dict, text: str):
    (message,) = (e for e in EXAMPLES if type(e) is example)
    with pytest.raises(MessageError, match=text):
        wire.decode(wire.encode(message.model_copy(update=changes)), example)


def test_a_long_bad_list_costs_one_error():
    data = packed(m.Roster, {"frame": 1, "process": "p", "scanning": [], "agents": [1] * 200_000})
    with pytest.raises(MessageError, match=r"Roster\.agents\.0"):
        wire.decode(data, m.Roster)


def test_a_long_bad_map_costs_one_error():
    counts = {str(number): -1 for number in range(30_000)}
    (message,) = (e for e in EXAMPLES if type(e) is m.LaneCounts)
    data = packed(m.LaneCounts, message.model_dump() | {"upstream": counts})
    with pytest.raises(MessageError, match=r"LaneCounts\.upstream\.0: "):
        wire.decode(data, m.LaneCounts)


def test_a_header_of_lists_alone_is_refused():
    data = packed(m.Roster, {"agents": [[]] * 100_000})
    with pytest.raises(MessageError, match="too many lists and maps"):
        wire.decode(data, m.Roster)


def test_an_extension_is_no_part_of_a_header():
    header = msgpack.packb({"frames": 1, "reason": msgpack.ExtType(5, b"x")})
    data = wire.PREFIX.pack(wire.MAGIC, wire.VERSION, m.End.kind, len(header), 0) + header
    with pytest.raises(MessageError, match="extension 5 of 1 bytes"):
        wire.decode(data, m.End)


def test_only_a_setup_may_have_a_large_header():
    for kind, limit in ((m.Roster, 256 << 10), (m.Setup, 16 << 20)):
        head = wire.PREFIX.pack(wire.MAGIC, wire.VERSION, kind.kind, limit + 1, 0)
        with pytest.raises(MessageError, match=f"limit {limit}"):
            wire.decode(head, kind)


@given(st.text(max_size=512))
def test_a_text_comes_through_unless_a_terminal_would_obey_it(text: str):
    controls = {chr(code) for code in (*range(32), *range(127, 160))}
    data = packed(m.End, {"frames": 1, "reason": text})
    if controls & set(text):
        with pytest.raises(MessageError, match=r"End\.reason"):
            wire.decode(data, m.End)
    else:
        assert wire.decode(data, m.End).reason == text


def test_a_setups_scenario_may_hold_several_lines():
    setup = EXAMPLES[0].model_copy(update={"scenario": {"note": "one\nanother\n"}})
    assert wire.decode(wire.encode(setup), m.Setup).scenario == {"note": "one\nanother\n"}


def test_an_array_with_a_default_may_be_missing_and_no_other():
    setup = next(example for example in EXAMPLES if isinstance(example, m.Setup))
    data = wire.encode(setup.model_copy(update={"mesh_materials": np.zeros(0, np.uint8)}))
    *_, length, _ = wire.PREFIX.unpack(data[: wire.PREFIX.size])
    packed_header = data[wire.PREFIX.size : wire.PREFIX.size + length]
    header = msgpack.unpackb(packed_header.rstrip(b"\xc0"))  # nil bytes follow the map
    body = data[wire.PREFIX.size + length :]

    def without(name: str) -> bytes:
        left = msgpack.packb({key: value for key, value in header.items() if key != name})
        prefix = wire.PREFIX.pack(wire.MAGIC, wire.VERSION, m.Setup.kind, len(left), len(body))
        return prefix + left + body

    assert wire.decode(without("mesh_materials"), m.Setup).mesh_materials.shape == (0,)
    with pytest.raises(MessageError, match="mesh_vertices has no valid shape"):
        wire.decode(without("mesh_vertices"), m.Setup)
