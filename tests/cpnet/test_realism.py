"""Presets of realism: what they set, what goes over them, and that their parts are all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from cpnet.scenario import _laid_over, load
from protocol.errors import ConfigError

ROOT = Path(__file__).parents[2]
NAMES = ("paper", "clear", "hard")


def layer(name: str) -> dict[str, Any]:
    text = (ROOT / "cpnet" / "realism" / f"{name}.yaml").read_text("utf-8")
    return yaml.safe_load(text) or {}


def preset(name: str) -> dict[str, Any]:
    """Returns the keys that a preset sets, nested: `hard` lies over `clear`."""
    return _laid_over(layer("clear"), layer("hard")) if name == "hard" else layer(name)


def dotted(data: dict[str, Any], depth: int = 9, before: str = "") -> dict[str, Any]:
    """Returns the leaves by their dotted keys."""
    found: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, dict):
            found |= dotted(value, depth - 1, f"{before}{key}.")
        else:
            found[f"{before}{key}"] = value
    return found


def test_the_paper_is_the_default_of_every_key():
    assert preset("paper") == {}
    assert load("t_junction", {}) == load("t_junction", {"realism": "paper"})


@pytest.mark.parametrize("name", NAMES)
def test_a_preset_sets_its_keys(name: str):
    dump = dotted(load("t_junction", {"realism": name}).model_dump(mode="json"))
    for key, value in dotted(preset(name)).items():
        if key != "traffic.vehicles":
            assert dump[key] == value, key


def test_a_scenarios_own_keys_go_over_the_presets():
    over = {"realism": "hard", "pose.clock_std_s": 0.5, "traffic.lateral.offset_std_m": 0}
    scenario = load("t_junction", over)
    assert scenario.pose.clock_std_s == 0.5
    assert scenario.traffic.lateral.offset_std_m == 0
    assert scenario.pose.drift_time_s == preset("hard")["pose"]["drift_time_s"]


def test_a_realism_that_there_is_not_is_refused_with_those_that_there_are():
    with pytest.raises(ConfigError, match="realism: .*'paper', 'clear' or 'hard'"):
        load("t_junction", {"realism": "easy"})


def test_the_study_of_realism_has_all_parts_of_hard():
    """Each once; what acts on the power that comes back stands beside the key that has it so."""
    study = yaml.safe_load((ROOT / "docs" / "figures" / "realism.yaml").read_text("utf-8"))
    parts = {name: one for name, one in study["axes"]["part"].items() if "realism" not in one}
    keys = [key for one in parts.values() for key in one if "range_at_10" not in key]
    assert len(keys) == len(set(keys))
    together = {key: value for one in parts.values() for key, value in one.items()}
    assert together == dotted(preset("hard"))
