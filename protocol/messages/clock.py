"""How processes on several machines come by one clock."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from protocol.messages.base import Message
from protocol.messages.fields import Id, Text, TimeNs


class TimeReply(Message):
    """What the host of the world bus answers to who asks for its clock."""

    kind: ClassVar[int] = 17
    machine: Text
    heard_ns: TimeNs
    told_ns: TimeNs


class ClockReading(Message):
    """What to add to a process's clock to have that of the world bus's host.

    It is wrong by `error_ns` at most; both are 0 on the same machine.
    """

    kind: ClassVar[int] = 18
    process: Id
    offset_ns: TimeNs
    error_ns: TimeNs = Field(ge=0)
