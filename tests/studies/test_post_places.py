"""Roadside posts stand beside the road."""

from __future__ import annotations

import numpy as np
import pytest

from perception.roadway import Roadway
from sim_host.setup import build_setup
from studies.post_places import post_place


@pytest.mark.parametrize("net", ["t_junction", "grid"])
def test_a_post_stands_beside_the_road_and_near_the_junction(net: str, tmp_path) -> None:
    road_map = build_setup({"traffic": {"network": net}, "junctions": "all"}, tmp_path).road_map
    beside = Roadway.of(road_map, margin_m=0)
    for one in road_map.intersections:
        x_m, y_m = post_place(road_map, one.signal.tls)
        assert not beside.contains(np.array([[one.centre[0] + x_m, one.centre[1] + y_m]]))[0]
        assert 3 < np.hypot(x_m, y_m) < 25
