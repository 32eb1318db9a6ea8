"""Limits on received data stand in one table, each with its reason."""

import re
from pathlib import Path

import recording
from recording import limits

PACKAGE = Path(recording.__file__).parent
TABLE = PACKAGE / "limits.py"
OF_OUR_OWN = {
    "MAX_POINTS": "that are written for Foxglove",
    "MAX_POSE": "that a message takes",
    "MAX_VALUE_CHARS": "that a difference shows",
}


def test_every_limit_has_a_reason_and_is_used():
    sources = [path.read_text() for path in PACKAGE.rglob("*.py") if path != TABLE]
    names = [name for name in vars(limits) if name.startswith("MAX_") and name != "MAX_BODY_BYTES"]
    assert len(names) > 15
    for name in names:
        assert any(re.search(rf"\b{name}\b", source) for source in sources), name
        assert re.search(rf"^{name} = .*  # ", TABLE.read_text(), re.M), name


def test_no_limit_is_set_beside_the_table():
    found = {
        name
        for path in PACKAGE.rglob("*.py")
        if path != TABLE
        for name in re.findall(r"^_?(MAX_[A-Z_]+)\b[^\n]* = ", path.read_text(), re.M)
    }
    assert found == OF_OUR_OWN.keys()
