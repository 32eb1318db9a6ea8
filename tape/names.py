"""What a tape's files are called, and what in them is called how."""

from __future__ import annotations

import re
from pathlib import Path

STEM = "run"
SETUP = "setup.msgpack"
"""The attachment with the Setup message, before all else."""
SETUP_TYPE = "application/x-cpnet"
FACTS = "cpnet"
"""The metadata that says what was taped: written at the start."""
GOES_ON_FROM = "goes_on_from"
"""Among these facts, where a tape has grown long: the name of the file before."""
CLOSING = "cpnet.closing"
"""The metadata that says what came of it: written at the end."""
ENCODING = "cpnet"
"""The encoding of native messages: `protocol.wire`."""
TOPIC = "topic"
"""The name in the topic table, in a native channel's metadata."""


def next_file(folder: Path, stem: str = STEM) -> Path:
    """Returns the first of STEM.mcap, STEM-2.mcap, … that is after all that are there."""
    last = max((number for number, _ in _numbered(folder, stem)), default=0)
    return folder / (f"{stem}-{last + 1}.mcap" if last else f"{stem}.mcap")


def files_in(folder: Path, stem: str = STEM) -> list[Path]:
    """Returns the files of a tape in the order in which they were written."""
    return [path for _, path in sorted(_numbered(folder, stem))]


def _numbered(folder: Path, stem: str) -> list[tuple[int, Path]]:
    pattern = re.compile(rf"{re.escape(stem)}(?:-([1-9]\d{{0,5}}))?\.mcap")
    found = ((pattern.fullmatch(path.name), path) for path in folder.iterdir())
    return [(int(match[1] or 1), path) for match, path in found if match]
