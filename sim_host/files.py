"""Files that SUMO reads, gzipped or not."""

from __future__ import annotations

import gzip
import zlib
from io import BufferedReader
from pathlib import Path
from xml.etree import ElementTree

Stream = BufferedReader | gzip.GzipFile
UNREADABLE = (ElementTree.ParseError, OSError, EOFError, zlib.error)
"""What reading such a file as XML raises if it is damaged."""


def open_file(path: Path) -> Stream:
    """Opens a file; one that is gzipped, by its name, is unpacked as it is read."""
    return gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb")
