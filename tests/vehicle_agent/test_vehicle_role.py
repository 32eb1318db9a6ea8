"""The vehicle role: handling of received messages."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.errors import MessageError
from protocol.inbox import Envelope
from protocol.messages import TileBodies
from vehicle_agent.role import VehicleRole


def test_a_body_of_an_unknown_type_is_refused() -> None:
    bodies = TileBodies(
        frame=0,
        column=0,
        row=0,
        ids=["a"],
        types=["zeppelin"],
        poses=np.zeros((1, 6)),
        speeds_mps=np.zeros(1, np.float32),
    )
    role = VehicleRole.__new__(VehicleRole)
    role._types = {}
    with pytest.raises(MessageError, match="zeppelin"):
        role.on(Envelope("bodies", {"tile": "0.0"}, bodies, 0, b""))
