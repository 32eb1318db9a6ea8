"""The vehicle role, as far as it looks at what it hears."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.errors import MessageError
from protocol.inbox import Envelope
from protocol.messages import Tick
from vehicle_agent.role import VehicleRole


def test_a_tick_with_an_unknown_type_of_vehicle_is_refused() -> None:
    tick = Tick(
        frame=0,
        sim_time_ns=0,
        processes=[],
        ids=["a"],
        types=["zeppelin"],
        poses=np.zeros((1, 6)),
        speeds_mps=np.zeros(1, np.float32),
        equipment=np.zeros(1, np.uint8),
        hosts=np.array([-1], np.int32),
    )
    role = VehicleRole.__new__(VehicleRole)
    role._types = {}
    with pytest.raises(MessageError, match="zeppelin"):
        role.on(Envelope("tick", {}, tick, 0, b""))
