"""Inference with the network, and its weight file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `learn`")

from safetensors.torch import load_file, save_file  # noqa: E402 - after the check for torch

from perception.config import PillarsDetection  # noqa: E402
from perception.detector import Cloud  # noqa: E402
from perception.pillars.config import NETWORKS, PillarsConfig  # noqa: E402
from perception.pillars.detector import (  # noqa: E402
    Engine,
    PillarsDetector,
    Seen,
    pillars_detector,
)
from perception.pillars.network import Batch, PointPillars  # noqa: E402
from perception.pillars.weights import SHIPPED, load, save  # noqa: E402
from perception.pillars.windows import Window, pillars_of  # noqa: E402
from perception.roadway import Placed, Roadway  # noqa: E402
from protocol.errors import ConfigError  # noqa: E402
from protocol.messages import ObjectClass  # noqa: E402
from tests.roads import lane, no_road  # noqa: E402

TINY = PillarsConfig(pillar_channels=8, channels=(8, 8, 8), layers=(0, 0, 0), up_channels=8)
CPU = torch.device("cpu")


def network(seed: int = 1) -> PointPillars:
    """A network whose norms have seen something."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        made = PointPillars(TINY)
        for _ in range(3):
            made.head(torch.rand(2, 8, 32, 32))
            made.pillars(torch.randn(50, 6), torch.arange(50) % 7, 7)
    return made.eval()


def roadway() -> Roadway:
    wide = lane("a_0", [(-50, 0, 0), (50, 0, 0)], width_m=8)
    return Roadway.of(no_road().model_copy(update={"lanes": [wide]}), margin_m=0.5)


def cloud(points: np.ndarray) -> Cloud:
    points = np.asarray(points, np.float32).reshape(-1, 3)
    near = Placed.of(points, np.zeros(len(points), np.float32))
    return Cloud([near], [], np.zeros((1, 3)))


def test_the_engine_says_what_the_network_says() -> None:
    made, window = network(), Window(np.array([-8.0, -8.0]), 64, 64)
    points = np.random.default_rng(1).uniform(-8, 8, (3000, 3)).astype(np.float32)
    pillars = pillars_of(points, points[:, 2].copy(), window, TINY)
    batch = Batch.of([pillars, pillars], (64, 64), CPU)
    with torch.inference_mode():
        outputs = made(batch.features, batch.pillar, batch.cell, batch.shape)
        engine = Engine(network(), CPU, half=False)
        for _ in range(2):  # nothing is left of what was asked before
            known, cells = engine.encode(points, points[:, 2].copy(), window)
            again = engine.head(known, [Seen(np.arange(len(cells)), cells)] * 2, (64, 64))
            torch.testing.assert_close(again, outputs, rtol=1e-4, atol=1e-4)


def test_a_batch_keeps_windows_apart() -> None:
    made, window = network(), Window(np.array([-8.0, -8.0]), 64, 64)
    rng = np.random.default_rng(2)
    parts = []
    for _ in range(2):
        points = rng.uniform(-8, 8, (500, 3)).astype(np.float32)
        parts.append(pillars_of(points, points[:, 2].copy(), window, TINY))
    with torch.inference_mode():
        both = Batch.of(parts, (64, 64), CPU)
        outputs = made(both.features, both.pillar, both.cell, both.shape)
        for number, part in enumerate(parts):
            one = Batch.of([part], (64, 64), CPU)
            alone = made(one.features, one.pillar, one.cell, one.shape)
            torch.testing.assert_close(outputs[number : number + 1], alone)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.zeros((1, 3)),
        np.random.default_rng(3).uniform([-40, -4, -0.05], [40, 4, 0.05], (30_000, 3)),
        np.random.default_rng(4).uniform([-40, -4, 50], [40, 4, 60], (100, 3)),
    ],
    ids=["empty", "one point", "ground", "all too high"],
)
def test_odd_clouds_give_boxes_on_the_road_or_none(points: np.ndarray) -> None:
    detector = PillarsDetector(
        Engine(network(), CPU, half=False), roadway(), PillarsDetection(min_score=0.5)
    )
    found = detector.detect(cloud(points), np.random.default_rng(1))
    assert found.boxes.shape == (len(found), 7)
    assert np.isfinite(found.boxes).all()
    if len(points) < 2 or points[0, 2] > 40:
        assert len(found) == 0


def test_weights_come_back_with_what_is_known_of_them(tmp_path: Path) -> None:
    made, path = network(), tmp_path / "w.safetensors"
    save(made, path, {"seed": 7})
    again, about = load(path)
    assert about == {"seed": 7}
    assert again.config == TINY
    for name, value in made.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=1e-3, atol=1e-4)


def spoilt(path: Path, how: str) -> None:
    tensors = load_file(path)
    metadata = {"format": "cpnet-pillars-1", "config": TINY.model_dump_json(), "about": "{}"}
    if how == "bytes":
        path.write_bytes(path.read_bytes()[:100])
    elif how == "another file":
        save_file(tensors, path, {"format": "other"})
    elif how == "no config":
        save_file(tensors, path, metadata | {"config": "{}}"})
    elif how == "another width":
        wide = TINY.model_copy(update={"up_channels": 16})
        save_file(tensors, path, metadata | {"config": wide.model_dump_json()})
    elif how == "a tensor less":
        del tensors["encode.weight"]
        save_file(tensors, path, metadata)
    elif how == "nan":
        tensors["encode.weight"][0, 0] = float("nan")
        save_file(tensors, path, metadata)
    else:
        path.unlink()


@pytest.mark.parametrize(
    ("how", "error_text"),
    [
        ("bytes", "weights .*"),
        ("another file", "format 'other', needs 'cpnet-pillars-1'"),
        ("no config", "description is not valid"),
        ("another width", "not those of its network"),
        ("a tensor less", "not those of its network"),
        ("nan", "not finite"),
        ("gone", "there is no such file"),
    ],
)
def test_weights_that_cannot_be_right_are_refused(
    tmp_path: Path, how: str, error_text: str
) -> None:
    path = tmp_path / "w.safetensors"
    save(network(), path, {})
    spoilt(path, how)
    with pytest.raises(ConfigError, match=error_text):
        load(path)


@pytest.mark.parametrize("name", list(NETWORKS))
def test_the_shipped_weights_load_and_say_how_they_were_made(name: str) -> None:
    path = SHIPPED / f"{name}.safetensors"
    assert path.stat().st_size < 20 << 20
    network, about = load(path)
    assert network.config.channels == NETWORKS[name].channels
    assert set(network.config.classes().tolist()) == set(ObjectClass)
    assert about["network"] == name
    assert about["recipe"]["seed"] == 1
    assert about["dataset"]["realism"] == "hard"
    pillars_detector(name, PillarsDetection(), roadway())
