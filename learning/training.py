"""Training: steps of AdamW over windows drawn by seed and step, so that it can be resumed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from learning.examples import Example, Sight, example_of
from learning.loss import losses_of
from perception.pillars.config import PillarsConfig
from perception.pillars.network import Batch, PointPillars, lay_channels_last
from protocol.errors import ConfigError

_WARM_UP = 0.1  # share of the steps in which the rate rises
_CLIP = 10.0
_STATE = "training.safetensors"
_MOMENTS = ("exp_avg", "exp_avg_sq", "step")


class Sights(Protocol):
    """Moments ready to draw windows from."""

    def __len__(self) -> int:
        """How many there are."""

    def __getitem__(self, index: int) -> Sight:
        """Returns one."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """All that decides the result, but for the data and the network's shape."""

    steps: int
    windows: int = 4  # a step
    cells: int = 320  # of a window
    rate: float = 3e-3
    decay: float = 0.01
    seed: int = 1

    def as_dict(self) -> dict[str, float]:
        """Returns it as plain numbers."""
        return asdict(self)

    def rate_at(self, step: int) -> float:
        """Returns the learning rate: up in a line, down in half a cosine."""
        share = (step + 1) / self.steps
        if share < _WARM_UP:
            return self.rate * share / _WARM_UP
        return self.rate * 0.5 * (1 + float(np.cos(np.pi * (share - _WARM_UP) / (1 - _WARM_UP))))


@dataclass(frozen=True, slots=True)
class Progress:
    """What a step gave."""

    step: int
    score_loss: float
    box_loss: float


class Trainer:
    """Holds a network and its optimiser; `run` goes on from where it was left."""

    def __init__(self, config: PillarsConfig, recipe: Recipe, device: torch.device) -> None:
        self.recipe = recipe
        self.step = 0
        self._device = device
        with torch.random.fork_rng():
            torch.manual_seed(recipe.seed)
            network = PointPillars(config)
        self.network = network.to(device)
        lay_channels_last(self.network)
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=recipe.rate, weight_decay=recipe.decay
        )

    def run(self, sights: Sights) -> Iterator[Progress]:
        """Yields after each step; windows of the next one are drawn meanwhile."""
        with ThreadPoolExecutor(1) as pool:
            ahead = pool.submit(self._draw, sights, self.step)
            while self.step < self.recipe.steps:
                examples = ahead.result()
                ahead = pool.submit(self._draw, sights, min(self.step + 1, self.recipe.steps - 1))
                yield self._learn(examples)

    def _draw(self, sights: Sights, step: int) -> list[Example]:
        rng = np.random.default_rng([self.recipe.seed, step])
        chosen = rng.integers(len(sights), size=self.recipe.windows)
        config = self.network.config
        return [example_of(sights[int(i)], self.recipe.cells, config, rng) for i in chosen]

    def _learn(self, examples: list[Example]) -> Progress:
        self.network.train()
        for group in self._optimiser.param_groups:
            group["lr"] = self.recipe.rate_at(self.step)
        batch = Batch.of([e.pillars for e in examples], (self.recipe.cells,) * 2, self._device)
        with torch.autocast(self._device.type, dtype=torch.bfloat16):
            head = self.network(batch.features, batch.pillar, batch.cell, batch.shape)
        losses = losses_of(head, [e.targets for e in examples], self._device)
        self._optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(losses.total)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), _CLIP)
        self._optimiser.step()
        self.step += 1
        return Progress(self.step, float(losses.score.detach()), float(losses.box.detach()))

    def save(self, folder: Path) -> None:
        """Writes what `resume` needs; an older state is replaced whole."""
        tensors = {f"network.{k}": v.contiguous() for k, v in self.network.state_dict().items()}
        for number, parameter in enumerate(self.network.parameters()):
            state = self._optimiser.state[parameter]
            tensors |= {
                f"optimiser.{number}.{key}": torch.as_tensor(state[key]).contiguous()
                for key in _MOMENTS
                if key in state
            }
        temporary = folder / f"{_STATE}.tmp"
        save_file(tensors, temporary, {"step": str(self.step), "recipe": self._recipe_text()})
        temporary.replace(folder / _STATE)

    def resume(self, folder: Path) -> bool:
        """Takes up a state of the same recipe; False if there is none.

        Raises:
            ConfigError: the state is broken.
        """
        path = folder / _STATE
        if not path.is_file():
            return False
        try:
            return self._take_up(path)
        except (SafetensorError, OSError, LookupError, RuntimeError, ValueError) as error:
            first = str(error).partition("\n")[0]
            raise ConfigError(
                f"state {path}: {first}; remove the file to train from the start"
            ) from None

    def _take_up(self, path: Path) -> bool:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no dict
        if metadata["recipe"] != self._recipe_text():
            return False
        step = int(metadata["step"])
        weights = {k[8:]: v for k, v in tensors.items() if k.startswith("network.")}
        self.network.load_state_dict(weights)
        for number, parameter in enumerate(self.network.parameters()):
            self._optimiser.state[parameter] = {
                key: tensors[f"optimiser.{number}.{key}"].to(
                    self._device if key != "step" else "cpu"
                )
                for key in _MOMENTS
                if f"optimiser.{number}.{key}" in tensors
            }
        self.step = step
        return True

    def _recipe_text(self) -> str:
        return json.dumps([self.network.config.model_dump(), self.recipe.as_dict()])
