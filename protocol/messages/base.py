"""What every message is made of."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel, ConfigDict


class Message(BaseModel):
    """Base of all messages. Unknown header fields are tolerated, so that a minor side may add."""

    model_config = ConfigDict(
        frozen=True, extra="ignore", arbitrary_types_allowed=True, allow_inf_nan=False
    )
    kind: ClassVar[int]
    max_header_bytes: ClassVar[int] = 256 << 10


class Part(BaseModel):
    """Base of what messages hold lists of."""

    model_config = ConfigDict(allow_inf_nan=False)


def check_lengths(message: Message, *columns: str) -> None:
    """Raises ValueError unless these columns of the message are equally long."""
    lengths = {name: len(getattr(message, name)) for name in columns}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"lists have lengths {lengths}, need one")
