"""Training goes on where it was left, and gives the same weights for the same seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `learn`")

from safetensors.torch import load_file, save_file  # noqa: E402 - after the check for torch

from learning.examples import PlacedSample  # noqa: E402
from learning.training import Recipe, Trainer, memory_bytes  # noqa: E402
from perception.pillars.config import PillarsConfig  # noqa: E402
from perception.pillars.weights import load, save  # noqa: E402
from protocol.errors import ConfigError  # noqa: E402

pytestmark = pytest.mark.slow

TINY = PillarsConfig(pillar_channels=8, channels=(8, 8, 8), layers=(0, 0, 0), up_channels=8)
RECIPE = Recipe(steps=4, windows=2, cells=64)
CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("limit", "is_less"), [("1000000\n", True), ("max\n", False), (None, False)]
)
def test_a_container_has_the_memory_that_it_is_given(
    tmp_path: Path, limit: str | None, is_less: bool
) -> None:
    if limit is not None:
        (tmp_path / "memory.max").write_text(limit)
    assert (memory_bytes(tmp_path / "memory.max") == 1_000_000) == is_less


def sample(seed: int) -> PlacedSample:
    """A flat place with a few cars of a hundred points each."""
    rng = np.random.default_rng(seed)
    boxes = np.array([[x, y, 0.75, 4.4, 1.8, 1.5, 0.3] for x in (-8, 4) for y in (-6, 6)])
    on_cars = [box[:3] + rng.uniform(-0.7, 0.7, (100, 3)) for box in boxes]
    ground = np.column_stack([rng.uniform(-30, 30, (2000, 2)), np.zeros(2000)])
    points = np.concatenate([ground, *on_cars]).astype(np.float32)
    everywhere = np.ones(len(points), np.bool_)
    hits = np.full((1, len(boxes)), 100)
    return PlacedSample(
        [points], [points[:, 2].copy()], [everywhere], boxes, np.zeros(len(boxes), np.uint8), hits
    )


SIGHTS = [sample(1), sample(2)]


def weights(trainer: Trainer) -> dict[str, object]:
    return {name: value.clone() for name, value in trainer.network.state_dict().items()}


def test_the_same_seed_gives_the_same_weights_also_when_it_was_interrupted(
    tmp_path: Path,
) -> None:
    whole = Trainer(TINY, RECIPE, CPU)
    assert [step.step for step in whole.run(SIGHTS)] == [1, 2, 3, 4]
    begun = Trainer(TINY, RECIPE, CPU)
    for step in begun.run(SIGHTS):
        if step.step == 2:
            begun.save(tmp_path)
            break
    resumed = Trainer(TINY, RECIPE, CPU)
    assert resumed.resume(tmp_path)
    assert [step.step for step in resumed.run(SIGHTS)] == [3, 4]
    for name, value in weights(whole).items():
        assert torch.equal(value, weights(resumed)[name]), name


def test_another_recipe_s_state_is_not_taken_up(tmp_path: Path) -> None:
    first = Trainer(TINY, RECIPE, CPU)
    next(iter(first.run(SIGHTS)))
    first.save(tmp_path)
    assert not Trainer(TINY, Recipe(steps=5, windows=2, cells=64), CPU).resume(tmp_path)
    assert not Trainer(TINY, RECIPE, CPU).resume(tmp_path / "nowhere")


def test_the_rate_rises_and_falls() -> None:
    rates = [Recipe(steps=100).rate_at(step) for step in range(100)]
    assert max(rates) == pytest.approx(3e-3, rel=0.01)
    assert rates.index(max(rates)) == pytest.approx(9, abs=1)
    assert rates[-1] < 1e-5


def test_losses_fall_on_what_is_shown_again_and_again() -> None:
    trainer = Trainer(TINY, Recipe(steps=60, windows=2, cells=64), CPU)
    steps = list(trainer.run(SIGHTS[:1]))
    first, last = (
        np.mean([s.score_loss + s.box_loss for s in part]) for part in (steps[:10], steps[-10:])
    )
    assert last < first / 2


@pytest.mark.parametrize("how", ["cut", "empty", "no recipe", "another network"])
def test_a_broken_state_is_named_and_not_trained_over(tmp_path: Path, how: str) -> None:
    begun, path = Trainer(TINY, RECIPE, CPU), tmp_path / "training.safetensors"
    next(iter(begun.run(SIGHTS)))
    begun.save(tmp_path)
    match how:
        case "cut":
            path.write_bytes(path.read_bytes()[:-10])
        case "empty":
            path.write_bytes(b"")
        case "no recipe":
            save_file(load_file(path), path)
        case _:
            metadata = {"step": "1", "recipe": begun._recipe_text()}
            save_file({"network.x": torch.zeros(2)}, path, metadata)
    before = path.read_bytes()
    with pytest.raises(ConfigError, match=r"training\.safetensors: .*remove the file"):
        Trainer(TINY, RECIPE, CPU).resume(tmp_path)
    assert path.read_bytes() == before


def test_training_begins_with_weights_that_are_given(tmp_path: Path) -> None:
    path = tmp_path / "tiny.safetensors"
    first, second = Trainer(TINY, RECIPE, CPU), Trainer(TINY, Recipe(steps=4, seed=2), CPU)
    list(first.run(SIGHTS))
    save(first.network, path, {})
    second.begin_with(load(path)[0], path)
    for name, value in weights(first).items():
        assert torch.allclose(weights(second)[name].float(), value.float(), rtol=2e-3, atol=1e-3)


def test_weights_of_another_network_are_no_beginning(tmp_path: Path) -> None:
    path = tmp_path / "tiny.safetensors"
    save(Trainer(TINY, RECIPE, CPU).network, path, {})
    wider = TINY.model_copy(update={"up_channels": 16})
    with pytest.raises(ConfigError, match=r"--start .*tiny.safetensors: .*another network"):
        Trainer(wider, RECIPE, CPU).begin_with(load(path)[0], path)
