"""Limits on received data stand in one table, each with its reason."""

import re
from pathlib import Path

import protocol
from protocol import limits
from protocol.messages import MESSAGES

PACKAGE = Path(protocol.__file__).parent
TABLE = PACKAGE / "limits.py"
HELD_ELSEWHERE = {
    "MAX_STEPS": "of profile fast, by its form: 16 bits",
    "MAX_UNITS": "of the model of a range image: 32 bits",
    "MAX_RINGS": "that an encoder looks for",
    "MAX_BOUND_M": "that an encoder takes",
    "MAX_VEHICLE_PROCESSES": "that get keys",
    "MAX_OPEN_FRAMES": "that an observer keeps",
    "MAX_FRAME_BYTES": "that an observer keeps",
    "MAX_FRAME_MESSAGES": "that an observer keeps",
}


def test_every_limit_has_a_reason_and_is_used():
    sources = [path.read_text() for path in PACKAGE.rglob("*.py") if path != TABLE]
    lines = TABLE.read_text().splitlines()
    names = [name for name in vars(limits) if name.isupper()]
    assert len(names) > 40
    for name in names:
        assert any(re.search(rf"\b{name}\b", source) for source in sources), name
    bare = {
        line.split(" = ")[0] for line in lines if re.match(r"[A-Z_]+ = ", line) and "#" not in line
    }
    assert bare == {"MAX_WIDTH_M", "MAX_HEIGHT_M", "MAX_INBOX_ITEMS"}  # as the line beside them


def test_no_limit_is_set_beside_the_table():
    found = {
        name
        for path in PACKAGE.rglob("*.py")
        if path != TABLE
        for name in re.findall(r"^_?((?:MAX|MOST)_[A-Z_]+)\b[^\n]* = ", path.read_text(), re.M)
    }
    assert found <= HELD_ELSEWHERE.keys()


def test_no_message_bounds_a_field_by_a_number_of_its_own():
    for path in (PACKAGE / "messages").glob("*.py"):
        bounds = re.findall(r"\b(?:le|lt|max_length)=([^,)]+)", path.read_text())
        assert {bound for bound in bounds if not bound.strip("-").isidentifier()} <= {"1"}, path


def test_headers_of_all_messages_are_bounded():
    sizes = {kind.max_header_bytes for kind in MESSAGES.values()}
    assert sizes == {
        limits.MAX_HEADER_BYTES,
        limits.MAX_WORLD_HEADER_BYTES,
        limits.MAX_SETUP_HEADER_BYTES,
    }
