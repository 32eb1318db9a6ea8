"""The MCAP library, which comes with the extra `tape`."""

from __future__ import annotations

from importlib.util import find_spec

from protocol.errors import ConfigError

if find_spec("mcap") is None:
    raise ConfigError("tapes need packages that are not installed: pip install 'cpnet-edge[tape]'")

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata
from mcap.writer import CompressionType, Writer

__all__ = [
    "Attachment",
    "Channel",
    "Chunk",
    "CompressionType",
    "McapError",
    "Message",
    "Metadata",
    "Opcode",
    "ReadDataStream",
    "Writer",
]
