"""File names, metadata names and schemas of an MCAP recording."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import CoreSchema

from protocol.messages import Message
from protocol.wire import array_fields

STEM = "run"
SETUP_ATTACHMENT = "setup.msgpack"
"""The attachment with the Setup message, before all else."""
SETUP_TYPE = "application/x-cpnet"
RUN_METADATA = "cpnet"
"""Metadata record with the facts of the run: written at the start."""
PREVIOUS_FILE = "goes_on_from"
"""Key of these facts, in continuation files: the name of the file before."""
CLOSING_METADATA = "cpnet.closing"
"""Metadata record with the outcome of the recording: written at the end."""
ENCODING = "cpnet"
"""The encoding of native messages: `protocol.wire`."""
TOPIC = "topic"
"""The name in the topic table, in a native channel's metadata."""


def next_file(folder: Path, stem: str = STEM) -> Path:
    """Returns the first of STEM.mcap, STEM-2.mcap, … after all existing files."""
    last = max((number for number, _ in _numbered(folder, stem)), default=0)
    return folder / (f"{stem}-{last + 1}.mcap" if last else f"{stem}.mcap")


def files_in(folder: Path, stem: str = STEM) -> list[Path]:
    """Returns the files of a recording in the order in which they were written."""
    return [path for _, path in sorted(_numbered(folder, stem))]


def _numbered(folder: Path, stem: str) -> list[tuple[int, Path]]:
    pattern = re.compile(rf"{re.escape(stem)}(?:-([1-9]\d{{0,5}}))?\.mcap")
    found = ((pattern.fullmatch(path.name), path) for path in folder.iterdir())
    return [(int(match[1] or 1), path) for match, path in found if match]


SCHEMA_ENCODING = "jsonschema"


class _Schema(GenerateJsonSchema):
    """JSON schema generator that leaves types without a JSON schema open: arrays."""

    def handle_invalid_for_json_schema(
        self,
        schema: CoreSchema,  # noqa: ARG002
        error_info: str,  # noqa: ARG002
    ) -> JsonSchemaValue:
        return {}


@cache
def name_of(message: type[Message]) -> str:
    """Returns the name of a message's schema."""
    return f"cpnet.{message.__name__}"


@cache
def schema_of(message: type[Message]) -> bytes:
    """Returns the JSON schema of a message's fields; arrays lie in the body, as `protocol.wire`."""
    schema: dict[str, Any] = message.model_json_schema(schema_generator=_Schema)
    for name, array in array_fields(message).items():
        sides = " x ".join("n" if side is None else str(side) for side in array.shape)
        schema["properties"][name] = {
            "type": "array",
            "items": {"type": "integer"},
            "description": f"shape of an array in the body: {sides} of {array.dtype}",
        }
    return json.dumps(schema, separators=(",", ":")).encode()
