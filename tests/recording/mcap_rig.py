"""Example messages as a recorder receives them, and recordings of them."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

from hypothesis import strategies as st

from protocol.inbox import Envelope
from protocol.messages import Message, Setup
from protocol.observer import ALL_TOPICS
from protocol.topics import TOPICS
from protocol.wire import decode
from recording.mcap.format import next_file
from recording.mcap.writer import McapWriter

GOLDEN = Path(__file__).parents[1] / "protocol" / "golden"


@cache
def golden(message: type[Message]) -> tuple[Message, bytes]:
    """Returns an example of a message, and its bytes."""
    data = (GOLDEN / f"{message.__name__}.bin").read_bytes()
    return decode(data, message), data


def setup() -> Setup:
    message = golden(Setup)[0]
    assert isinstance(message, Setup)
    return message


def envelope(topic: str, received_ns: int, name: str = "a") -> Envelope:
    """Returns a message whose key has this name in all its parts."""
    template = TOPICS[topic].template
    parts = {part[1:-1]: name for part in template.split("/") if part.startswith("{")}
    message, data = golden(TOPICS[topic].message)
    return Envelope(topic, parts, message, received_ns, data)


def writer_in(folder: Path) -> McapWriter:
    return McapWriter(lambda: next_file(folder), setup(), {"name": "a test"})


def same(one: Iterable[Envelope], other: Iterable[Envelope]) -> bool:
    """Whether these are the same messages in the same order."""
    return [*map(_fields, one)] == [*map(_fields, other)]


def _fields(item: Envelope) -> tuple[object, ...]:
    return item.topic, item.parts, item.data, item.received_ns


_names = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=8)


@st.composite
def recorded_messages(draw: st.DrawFn, most: int = 30) -> list[Envelope]:
    """Draws received messages: any at any keys, at times that do not run backwards."""
    drawn = st.tuples(st.sampled_from(sorted(ALL_TOPICS)), st.integers(0, 10**9), _names)
    now_ns, result = 0, []
    for topic, step_ns, name in draw(st.lists(drawn, max_size=most)):
        now_ns += step_ns
        result.append(envelope(topic, now_ns, name))
    return result
