"""The page about the protocol says what the code says."""

import re
from pathlib import Path

from protocol.topics import TOPICS

PAGE = Path(__file__).parents[2] / "docs" / "protocol.md"


def test_the_topic_table_of_the_page_is_that_of_the_code():
    rows = re.findall(
        r"^\| (\w+) \| `([^`]+)`[^|]*\| (\w+) \| (\w+) \| (\w+) \|$", PAGE.read_text(), re.M
    )
    want = [
        (t.name, t.template, t.message.__name__, t.bus.value, t.delivery.value)
        for t in TOPICS.values()
    ]
    assert [(n, k, m, b.lower(), d) for n, k, m, b, d in rows] == want
