"""Files of weights that are broken, or not those that the detector needs, and their errors."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `learn`")

from safetensors.torch import load_file, save_file  # noqa: E402 - after the check for torch

from perception.config import DetectionConfig  # noqa: E402
from perception.pillars.config import FULL  # noqa: E402
from perception.pillars.network import PointPillars  # noqa: E402
from perception.pillars.weights import SHIPPED, load, save  # noqa: E402
from perception.registry import check, detector_of  # noqa: E402
from perception.roadway import Roadway  # noqa: E402
from protocol.errors import ConfigError  # noqa: E402
from tests.roads import junction_road  # noqa: E402

GOOD = SHIPPED / "pointpillars.safetensors"
SHAPE = load(GOOD)[0].config
METADATA = {"format": "cpnet-pillars-1", "config": SHAPE.model_dump_json(), "about": "{}"}
ENDLESS = "[" * 100_000
Tensors = dict[str, Any]


def tensors(
    change: Callable[[Tensors], Tensors] = dict, **metadata: str
) -> Callable[[Path], object]:
    return lambda path: save_file(change(load_file(GOOD)), path, METADATA | metadata)


def data(content: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content(GOOD.read_bytes()))


def holding(value: float) -> Callable[[Tensors], Tensors]:
    def change(given: Tensors) -> Tensors:
        given["score.weight"].view(-1)[3] = value
        return given

    return change


def negative(given: Tensors) -> Tensors:
    return given | {"norm.running_var": -given["norm.running_var"]}


def whole_numbers(given: Tensors) -> Tensors:
    return given | {"encode.weight": given["encode.weight"].int()}


def vast() -> str:
    return json.dumps(SHAPE.model_dump(mode="json") | {"channels": [1024] * 3, "layers": [150] * 3})


SPOILT: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda _: None, "there is no such file"),
    "folder": (Path.mkdir, "is a folder, needs a file"),
    "empty": (data(lambda _: b""), "no whole safetensors file"),
    "random": (data(lambda _: np.random.default_rng(1).bytes(5000)), "no whole safetensors file"),
    "cut": (data(lambda whole: whole[:-1000]), "no whole safetensors file"),
    "cut in its header": (data(lambda whole: whole[:100]), "no whole safetensors file"),
    "longer": (data(lambda whole: whole + b"more"), "no whole safetensors file"),
    "huge header": (data(lambda _: struct.pack("<Q", 1 << 60) + b"{}"), "no whole safetensors"),
    "large header": (data(lambda _: struct.pack("<Q", 90 << 20) + b"{}"), "no whole safetensors"),
    "no metadata": (lambda path: save_file(load_file(GOOD), path), "format None, needs 'cpnet-"),
    "no json": (tensors(config="{not json"), "description is not valid: config: Invalid JSON"),
    "endless json": (tensors(config=ENDLESS), "description is not valid: config: Invalid JSON"),
    "about is no json": (tensors(about="[1"), "description is not valid"),
    "about is endless": (tensors(about=ENDLESS), "description is not valid"),
    "about is a list": (tensors(about="[1]"), "about is a list, needs an object"),
    "another width": (
        tensors(config=SHAPE.model_copy(update={"up_channels": 64}).model_dump_json()),
        "is [32, 32, 1, 1], needs [64, 32, 1, 1]",
    ),
    "other layers": (tensors(config=FULL.model_dump_json()), "48 tensors are missing"),
    "gigabytes, it says": (tensors(config=vast()), "tensors are missing"),
    "more": (tensors(lambda t: t | {"own": torch.zeros(2)}), "1 tensors are of no use"),
    "nan": (tensors(holding(float("nan"))), "score.weight holds numbers that are not finite"),
    "inf": (tensors(holding(float("inf"))), "score.weight holds numbers that are not finite"),
    "negative variance": (tensors(negative), "norm.running_var is a variance"),
    "whole numbers": (tensors(whole_numbers), "encode.weight is of torch.int32, needs"),
}


def asked(name: str, path: Path | None) -> DetectionConfig:
    given = {"detector": name, "pillars": {"weights": None if path is None else str(path)}}
    return DetectionConfig.model_validate(given)


def refused(name: str, path: Path | None) -> str:
    """Returns the error, on one line, before a start and by who would build the detector."""
    with pytest.raises(ConfigError) as early:
        check(asked(name, path))
    with pytest.raises(ConfigError) as late:
        detector_of(asked(name, path), Roadway.of(junction_road(), margin_m=0.5))
    assert str(early.value) == str(late.value)
    assert "\n" not in str(early.value)
    return str(early.value)


@pytest.mark.parametrize("how", SPOILT)
def test_what_is_wrong_with_a_file_is_said_with_its_name(tmp_path: Path, how: str) -> None:
    path = tmp_path / "own.safetensors"
    spoil, error_text = SPOILT[how]
    spoil(path)
    message = refused("pointpillars", path)
    assert message.startswith(f"weights {path}: ")
    assert error_text in message
    assert len(message) < 400 + len(str(path))


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b"])
def test_a_name_that_no_file_can_have_is_no_file(name: str) -> None:
    assert "there is no such file" in refused("pointpillars", Path(name))


def test_weights_of_the_other_network_are_refused(tmp_path: Path) -> None:
    message = refused("pointpillars-full", GOOD)
    assert message == f"weights {GOOD}: they are of pointpillars, not of pointpillars-full"
    path = tmp_path / "full.safetensors"
    save(PointPillars(FULL), path, {})
    assert "they are of pointpillars-full, not of pointpillars" in refused("pointpillars", path)
    check(asked("pointpillars-full", path))


@pytest.mark.parametrize("name", ["fast", "reference"])
def test_other_detectors_ask_for_no_weights(name: str) -> None:
    check(asked(name, Path("nowhere")))
