"""Lines of a process's log for people, however it was written."""

from __future__ import annotations

import json


def readable(line: str) -> str:
    """Returns a line of JSON as it would stand in a log of text, any other line as it is."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return line
    if not isinstance(record, dict) or not {"level", "message"} <= record.keys():
        return line
    words = (record.get(key) for key in ("time", "process", "level", "logger"))
    head = " ".join(str(word) for word in words if word)
    told = f"{head}: {record['message']}"
    return f"{told}\n{record['exception']}" if record.get("exception") else told
