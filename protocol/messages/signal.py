"""What is said of the signal: what it shows, and what a policy wants it to show."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from protocol.messages.base import Message
from protocol.messages.fields import BOUNDED, DelayNs, FrameNumber, Lights, NetId, Text, TimeNs


class SignalState(Message):
    """Signal phase and timing (SPaT). `stage` is green, yellow or all_red; `source` who asked."""

    kind: ClassVar[int] = 6
    frame: FrameNumber
    sim_time_ns: TimeNs
    tls: NetId
    state: Lights
    stage: Text
    green: Text
    source: Text
    earliest_change_ns: TimeNs


class SignalRequest(Message):
    """A policy's wish: the green state to be shown, one character per link.

    `policy` is what decided, "plan" where the policy knew too little and fell back on the fixed
    plan. `unknown` are the lanes that nobody saw, whose vehicles were reckoned.
    """

    kind: ClassVar[int] = 7
    frame: FrameNumber
    sim_time_ns: TimeNs
    tls: NetId
    state: Text
    policy: Text
    pressures: Annotated[list[float], *BOUNDED] = Field([])
    unknown: Annotated[list[NetId], *BOUNDED] = Field([])
    delay_sim_ns: DelayNs | None = None
