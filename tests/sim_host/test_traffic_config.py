"""Traffic and cabinet sections refuse what cannot be."""

import subprocess
import sys

import pytest
from pydantic import ValidationError

from sim_host.config import CabinetConfig, LateralConfig, TrafficConfig
from tests.waiting import TIMEOUT_S


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"net": "a", "sumocfg": "b"}, "not both"),
        ({"routes": "r"}, "routes needs net"),
        ({"net": "a", "routes": "r", "demand_vph_per_lane": {"e": 1}}, "not both"),
        ({"cav_rate": 0.7, "cv_rate": 0.7}, "more than 1"),
        ({"demand_vph_per_lane": {"e": -1}}, "demand_vph_per_lane.e"),
        ({"vehicles": [{"name": "a"}, {"name": "a"}]}, "each may stand once"),
        ({"vehicles": []}, "at least 1"),
        ({"cav_rat": 0.1}, "Extra inputs"),
    ],
)
def test_traffic_that_cannot_be_is_refused(fields: dict[str, object], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        TrafficConfig.model_validate(fields)


def test_every_field_has_a_default_and_a_description() -> None:
    for section in (TrafficConfig, LateralConfig, CabinetConfig):
        section()
        assert all(field.description for field in section.model_fields.values())


def test_default_vehicles_pass_the_papers_size_filter() -> None:
    for kind in TrafficConfig().vehicles:
        assert 0.5 <= kind.length_m <= 6
        assert 0.5 <= kind.width_m <= 3
        assert 0.1 <= kind.height_m <= 2


def test_configuration_and_cabinet_need_no_sumo() -> None:
    code = (
        "import sys, sim_host.config, sim_host.cabinet, sim_host.world, sim_host.setup;"
        "assert not {'sumo', 'libsumo', 'sumolib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=TIMEOUT_S)
