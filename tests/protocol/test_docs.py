"""The topic table of docs/protocol.md is that of the code."""

import re
from pathlib import Path

from protocol.topics import QUERIED, ROLES, TOPICS

OBSERVERS = frozenset({"view", "mcap"})
PAGE = Path(__file__).parents[2] / "docs" / "protocol.md"


def test_the_topic_table_of_the_page_is_that_of_the_code():
    rows = re.findall(
        r"^\| (\w+) \| `([^`]+)`( \(query\))? \| (\w+) \| (\w+) \| (\w+) \| ([^|]+) \| ([^|]+) \|$",
        PAGE.read_text(),
        re.M,
    )
    want = [
        (
            (t.name, t.template, t.name in QUERIED, t.message.__name__, t.bus.value),
            (t.delivery.value, t.publishers, t.subscribers),
        )
        for t in TOPICS.values()
    ]
    assert [
        ((n, key, bool(query), m, bus.lower()), (d, roles(publishers), roles(subscribers)))
        for n, key, query, m, bus, d, publishers, subscribers in rows
    ] == want


def roles(cell: str) -> frozenset[str]:
    """Reads a cell of the table: roles, or a word for several."""
    several = {"all": ROLES, "agents": frozenset({"vehicle", "infra"}), "observers": OBSERVERS}
    return frozenset().union(*(several.get(name, {name}) for name in cell.split(", ")))
