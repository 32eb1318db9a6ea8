"""What the messages on a tape look like, as JSON schema, for tools that list channels."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import CoreSchema

from protocol.messages import Message
from protocol.wire import array_fields

ENCODING = "jsonschema"


class _Schema(GenerateJsonSchema):
    """Leaves open what JSON schema has no name for; only arrays are such."""

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
