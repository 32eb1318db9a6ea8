"""The bounds of docs/reliability.md on one message, as properties of any message."""

from __future__ import annotations

import struct

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import messages as m
from protocol import wire
from protocol.errors import MessageError
from protocol.inbox import Inbox, RawMessage
from protocol.limits import (
    MAX_AGENT_ID_BYTES,
    MAX_BODIES,
    MAX_BODY_BYTES,
    MAX_CONTAINERS,
    MAX_ID_CHARS,
    MAX_ITEMS,
    MAX_KEPT_BEAMS,
    MAX_KEPT_PATTERNS,
    MAX_KEY_CHARS,
)
from protocol.messages import MESSAGES
from protocol.scans import ScanPattern, _directions, _spin
from protocol.topics import TOPICS
from tests.messages import EXAMPLES

CONTROLS = {chr(code) for code in (*range(32), *range(127, 160))}
(POSE,) = (example for example in EXAMPLES if isinstance(example, m.AgentPose))
(TILE,) = (example for example in EXAMPLES if isinstance(example, m.TileBodies))
KINDS = st.sampled_from(list(MESSAGES.values()))


def packed(kind: type[m.Message], header: object) -> bytes:
    data = msgpack.packb(header)
    return wire.PREFIX.pack(wire.MAGIC, wire.VERSION, kind.kind, len(data), 0) + data


def roster(agents: list[object]) -> bytes:
    return packed(m.Roster, {"frame": 1, "process": "p", "agents": agents, "scanning": []})


@given(KINDS, st.integers(1, (1 << 32) - 1))
def test_a_header_longer_than_its_kind_allows_is_refused_unread(
    kind: type[m.Message], excess: int
) -> None:
    length = min(kind.max_header_bytes + excess, (1 << 32) - 1)
    head = wire.PREFIX.pack(wire.MAGIC, wire.VERSION, kind.kind, length, 0)
    with pytest.raises(MessageError, match=f"header has length {length}, limit"):
        wire.decode(head, kind)


@given(KINDS, st.integers(MAX_BODY_BYTES + 1, (1 << 32) - 1))
def test_a_body_longer_than_any_is_refused_unread(kind: type[m.Message], length: int) -> None:
    head = wire.PREFIX.pack(wire.MAGIC, wire.VERSION, kind.kind, 1, length)
    with pytest.raises(MessageError, match=f"body has length {length}, limit"):
        wire.decode(head, kind)


IDS = st.one_of(
    st.text(max_size=2 * MAX_ID_CHARS),
    st.builds(str.__mul__, st.sampled_from("aé€😀"), st.integers(0, 2 * MAX_ID_CHARS)),
)


@given(IDS)
def test_an_agents_id_has_so_many_characters_and_bytes_and_no_control(agent: str) -> None:
    size = len(agent.encode())
    is_one = 1 <= len(agent) <= MAX_ID_CHARS and size <= MAX_AGENT_ID_BYTES
    data = wire.encode(POSE.model_copy(update={"agent": agent}))
    if is_one and not CONTROLS & set(agent):
        assert wire.decode(data, m.AgentPose).agent == agent
    else:
        with pytest.raises(MessageError, match=r"AgentPose\.agent"):
            wire.decode(data, m.AgentPose)


@settings(max_examples=20, deadline=None)
@given(st.integers(MAX_ITEMS - 2, MAX_ITEMS + 2))
def test_a_list_has_so_many_entries(count: int) -> None:
    data = roster([f"{n}" for n in range(count)])
    if count <= MAX_ITEMS:
        assert len(wire.decode(data, m.Roster).agents) == count
    else:
        with pytest.raises(MessageError, match=r"Roster\.agents"):
            wire.decode(data, m.Roster)


@settings(max_examples=6, deadline=None)
@given(st.integers(MAX_BODIES + 1, MAX_BODIES + 100))
def test_a_list_of_bodies_has_more_entries_and_has_an_end(count: int) -> None:
    data = wire.encode(TILE.model_copy(update={"ids": ["a"] * count}))
    with pytest.raises(MessageError, match=r"TileBodies\.ids: .*65536"):
        wire.decode(data, m.TileBodies)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40_000), st.integers(0, 1 << 17))
def test_a_header_holds_so_many_lists_and_maps_and_more_for_its_bytes(
    lists: int, padding: int
) -> None:
    data = roster([[]] * lists + ["x" * padding])
    (length,) = struct.unpack_from("<I", data, struct.calcsize("<4sHH"))
    with pytest.raises(MessageError) as refused:  # an agent is no list, in any case
        wire.decode(data, m.Roster)
    # The list of agents, that of scanning and the header itself are three.
    are_too_many = lists + 3 > MAX_CONTAINERS + length // 16
    assert ("too many lists and maps" in str(refused.value)) is are_too_many


@given(st.integers(MAX_KEY_CHARS + 1, 4 * MAX_KEY_CHARS))
def test_a_key_longer_than_any_is_dropped_and_not_kept(length: int) -> None:
    inbox = Inbox()
    inbox.put(RawMessage(TOPICS["roster"], "k" * length, b"", 0))
    assert inbox.get() is None
    assert sum(inbox.drops.values()) == 1


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 580), st.sampled_from([1, 8, 900])), max_size=40))
def test_directions_are_kept_of_so_many_patterns_of_so_many_beams(
    shapes: list[tuple[int, int]],
) -> None:
    for cache in (_spin, _directions):
        cache.cache_clear()
    for channels, columns in shapes:
        pattern = ScanPattern(channels, columns, 10.0, -30.0)
        assert pattern.directions.shape == (channels, columns, 3)
    usual = {shape for shape in shapes if shape[0] * shape[1] <= MAX_KEPT_BEAMS}
    for cache in (_spin, _directions):
        assert cache.cache_info().currsize == min(len(usual), MAX_KEPT_PATTERNS)
