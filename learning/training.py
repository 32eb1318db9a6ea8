"""Training of PointPillars: samples in memory, the loss, steps of AdamW that can be resumed.

Windows are drawn by seed and step; `train` is what `cpnet train` calls.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, smooth_l1_loss

from learning.dataset import Dataset, Split
from learning.examples import Example, PlacedSample, RoadRasters, Targets, example_of
from learning.real_frames import RealFrames
from perception.pillars.config import NETWORKS, PillarsConfig
from perception.pillars.detector import computes_in_half
from perception.pillars.network import BOX_TERMS, Batch, PointPillars, lay_channels_last
from perception.pillars.weights import load, save
from protocol.config import is_file
from protocol.errors import ConfigError

KEPT_SHARE = 0.4  # of the memory that this process may have
_CGROUP_MAX = Path("/sys/fs/cgroup/memory.max")  # a container's limit, or "max"


def memory_bytes(cgroup_max: Path = _CGROUP_MAX) -> int:
    """Returns the available memory: the machine's, or the limit of the container."""
    machine_bytes = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limit = cgroup_max.read_text().strip() if cgroup_max.is_file() else "max"
    return min(machine_bytes, int(limit)) if limit.isdecimal() else machine_bytes


class PlacedSamples:
    """One split of a data set, in memory; thread-safe."""

    def __init__(self, dataset: Dataset, split: Split) -> None:
        self._room_bytes = KEPT_SHARE * memory_bytes()
        self._dataset = dataset
        self._samples = dataset.samples(split)
        self._kept: dict[int, PlacedSample] = {}
        self._kept_bytes = 0
        self._roads = lru_cache(1024)(lambda network: RoadRasters(dataset.road_map(network)))

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> PlacedSample:
        """Returns a sample, read again if there was no room for it.

        Raises:
            ConfigError: its files cannot be read.
        """
        sample = self._kept.get(index)
        if sample is None:
            network, frame = self._samples[index]
            sample = self._roads(network).placed(self._dataset.load(network, frame))
            size_bytes = sum(points.nbytes * 2 for points in sample.points)
            if self._kept_bytes + size_bytes <= self._room_bytes:
                self._kept[index] = sample
                self._kept_bytes += size_bytes
        return sample


ALPHA, GAMMA = 0.25, 2.0
BOX_WEIGHT = 2.0
_BETA = 1 / 9


@dataclass(frozen=True, slots=True, eq=False)
class Losses:
    """Both parts of the loss, per vehicle anchor."""

    score: Tensor
    box: Tensor

    @property
    def total(self) -> Tensor:
        """The weighted sum."""
        return self.score + BOX_WEIGHT * self.box


def losses_of(head: Tensor, targets: list[Targets], device: torch.device) -> Losses:
    """Compares the head's output (B, 8 K, H, W) with the targets of each window."""
    windows = len(head)
    kinds = head.shape[1] // (1 + BOX_TERMS)
    logits = head[:, :kinds].reshape(windows, -1).float()
    wanted = torch.from_numpy(np.stack([t.is_vehicle for t in targets])).to(device).float()
    counts = torch.from_numpy(np.stack([t.counts for t in targets])).to(device).float()
    vehicles = max(float(sum(len(t.place) for t in targets)), 1.0)
    chance = torch.sigmoid(logits)
    miss = wanted * (1 - chance) + (1 - wanted) * chance
    weight = (wanted * ALPHA + (1 - wanted) * (1 - ALPHA)) * miss**GAMMA * counts
    entropy = binary_cross_entropy_with_logits(logits, wanted, reduction="none")
    return Losses((weight * entropy).sum() / vehicles, _box_loss(head, targets, device) / vehicles)


def _box_loss(head: Tensor, targets: list[Targets], device: torch.device) -> Tensor:
    windows, cells = len(head), head.shape[2] * head.shape[3]
    kinds = head.shape[1] // (1 + BOX_TERMS)
    terms = head[:, kinds:].reshape(windows, kinds, BOX_TERMS, cells)
    by_anchor = terms.permute(0, 1, 3, 2).reshape(-1, BOX_TERMS)
    anchors = kinds * cells
    places = [number * anchors + t.place.astype(np.int64) for number, t in enumerate(targets)]
    predicted = by_anchor[torch.from_numpy(np.concatenate(places)).to(device)].float()
    target = torch.from_numpy(np.concatenate([t.terms for t in targets])).to(device)
    off = predicted[:, :6] - target[:, :6]
    turn = torch.sin(predicted[:, 6] - target[:, 6])
    both = torch.cat([off, turn[:, None]], 1)
    return smooth_l1_loss(both, torch.zeros_like(both), beta=_BETA, reduction="sum")


_WARM_UP = 0.1  # share of the steps in which the rate rises
_CLIP = 10.0
_STATE = "training.safetensors"
_OPTIMISER_STATE = ("exp_avg", "exp_avg_sq", "step")


class SampleSource(Protocol):
    """Interface of samples from which windows are drawn."""

    def __len__(self) -> int:
        """How many there are."""

    def __getitem__(self, index: int) -> PlacedSample:
        """Returns one."""


class MixedSamples:
    """Generated samples and real ones, each so often that the real ones are their share of all."""

    def __init__(self, generated: SampleSource, real: Sequence[PlacedSample], share: float) -> None:
        self._generated, self._real = generated, real
        rounds = max(1, math.ceil(len(real) * (1 - share) / share / len(generated)))
        self._places = rounds * len(generated)
        self._real_places = round(share / (1 - share) * self._places)

    def __len__(self) -> int:
        return self._places + self._real_places

    def __getitem__(self, index: int) -> PlacedSample:
        """Returns a sample; generated ones come first."""
        if index < self._places:
            return self._generated[index % len(self._generated)]
        return self._real[(index - self._places) % len(self._real)]


@dataclass(frozen=True, slots=True)
class Recipe:
    """Hyperparameters; with data and network they decide the result."""

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
class StepLosses:
    """The losses of a step."""

    step: int
    score_loss: float
    box_loss: float


class Trainer:
    """A network with its optimiser; `run` continues from the last step.

    `data` describes what it is trained on: a state of other data is not resumed.
    """

    def __init__(
        self, config: PillarsConfig, recipe: Recipe, device: torch.device, data: str = ""
    ) -> None:
        self.recipe, self._data = recipe, data
        self.step = 0
        self._device = device
        self._half = computes_in_half(device)
        with torch.random.fork_rng():
            torch.manual_seed(recipe.seed)
            network = PointPillars(config)
        self.network = network.to(device)
        lay_channels_last(self.network)
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=recipe.rate, weight_decay=recipe.decay
        )

    def run(self, samples: SampleSource) -> Iterator[StepLosses]:
        """Yields after each step; windows of the next ones are drawn meanwhile, by all cores."""
        cores, steps = os.cpu_count() or 1, range(self.step, self.recipe.steps)
        with ThreadPoolExecutor(cores) as pool:
            ahead = deque(pool.submit(self._draw, samples, step) for step in steps[:cores])
            for step in steps:
                examples = ahead.popleft().result()
                if step + cores < self.recipe.steps:
                    ahead.append(pool.submit(self._draw, samples, step + cores))
                yield self._learn(examples)

    def _draw(self, samples: SampleSource, step: int) -> list[Example]:
        rng = np.random.default_rng([self.recipe.seed, step])
        chosen = rng.integers(len(samples), size=self.recipe.windows)
        config = self.network.config
        return [example_of(samples[int(i)], self.recipe.cells, config, rng) for i in chosen]

    def _learn(self, examples: list[Example]) -> StepLosses:
        self.network.train()
        for group in self._optimiser.param_groups:
            group["lr"] = self.recipe.rate_at(self.step)
        batch = Batch.of([e.pillars for e in examples], (self.recipe.cells,) * 2, self._device)
        with torch.autocast(self._device.type, torch.bfloat16, self._half):
            head = self.network(batch.features, batch.pillar, batch.cell, batch.shape)
        losses = losses_of(head, [e.targets for e in examples], self._device)
        self._optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(losses.total)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), _CLIP)
        self._optimiser.step()
        self.step += 1
        return StepLosses(self.step, float(losses.score.detach()), float(losses.box.detach()))

    def save(self, folder: Path) -> None:
        """Writes what `resume` needs; an older state is replaced whole."""
        tensors = {f"network.{k}": v.contiguous() for k, v in self.network.state_dict().items()}
        for number, parameter in enumerate(self.network.parameters()):
            state = self._optimiser.state[parameter]
            tensors |= {
                f"optimiser.{number}.{key}": torch.as_tensor(state[key]).contiguous()
                for key in _OPTIMISER_STATE
                if key in state
            }
        temporary = folder / f"{_STATE}.tmp"
        save_file(tensors, temporary, {"step": str(self.step), "recipe": self._recipe_text()})
        temporary.replace(folder / _STATE)

    def begin_with(self, network: PointPillars, path: Path) -> None:
        """Loads initial weights from a file.

        Raises:
            ConfigError: it has another shape or other anchors.
        """
        if network.config != self.network.config:
            raise ConfigError(f"--start {path}: it is of another network, or has other anchors")
        self.network.load_state_dict(network.state_dict())

    def resume(self, folder: Path) -> bool:
        """Resumes from a state of the same recipe; False if there is none.

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
                for key in _OPTIMISER_STATE
                if f"optimiser.{number}.{key}" in tensors
            }
        self.step = step
        return True

    def _recipe_text(self) -> str:
        config, recipe = self.network.config.model_dump(), self.recipe.as_dict()
        return json.dumps([config, recipe, self._data])


_SEEDS = 1 << 63
KEPT_LOSSES = 200  # steps whose mean loss is shown
SAVE_EVERY_S = 60.0


@dataclass(frozen=True, slots=True)
class Training:
    """A training: dataset, network, recipe, and the folder for weights and state.

    `start` are weights to begin with, of the same network and anchors; random ones without. `real`
    are frames mixed in. With `mean`, the result is the mean of `start` and of what was learnt from
    there, statistics of norms too (Wortsman et al. 2022).
    """

    dataset: Path
    out: Path
    network: str
    recipe: Recipe
    start: Path | None = None
    real: RealFrames | None = None
    mean: bool = False

    def check(self) -> None:
        """Raises ConfigError if it cannot be done."""
        if self.network not in NETWORKS:
            raise ConfigError(f"network {self.network!r}: allowed are {', '.join(NETWORKS)}")
        least = {"steps": 1, "windows": 1, "cells": 64}
        for name, low in least.items():
            value = getattr(self.recipe, name)
            if value < low or (name == "cells" and value % 8):
                raise ConfigError(f"--{name} {value}: must be at least {low}, cells in steps of 8")
        if not 0 <= self.recipe.seed < _SEEDS:
            raise ConfigError(f"--seed {self.recipe.seed}: must be 0 to {_SEEDS - 1}")
        if not 0 < self.recipe.rate <= 1:
            raise ConfigError(f"--rate {self.recipe.rate}: must be more than 0, at most 1")
        if is_file(self.out):
            raise ConfigError(f"--out {self.out}: is a file, needs a folder")
        if self.mean and self.start is None:
            raise ConfigError("--mean: needs --start, the weights to take the mean with")
        if self.real is not None:
            self.real.check()


def train(training: Training, console: Console) -> Path:
    """Trains, or resumes from the state in the folder; returns the weights' file.

    Raises:
        ConfigError: the data set or the folder's state cannot be read, or the folder be made.
    """
    training.check()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    samples = PlacedSamples(Dataset(training.dataset), "train")
    if not len(samples):
        raise ConfigError(f"dataset {training.dataset}: its training split is empty")
    try:
        training.out.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--out {training.out}: {error}") from None
    start = None if training.start is None else load(training.start)
    real = {} if training.real is None else training.real.samples()
    about = about_of(training, len(samples), list(real), None if start is None else start[1])
    trainer = Trainer(NETWORKS[training.network], training.recipe, device, json.dumps(about))
    if training.start is not None and start is not None:
        trainer.begin_with(start[0], training.start)
    if trainer.resume(training.out):
        console.print(f"going on after step {trainer.step}")
    elif (training.out / _STATE).is_file():
        console.print(f"{training.out / _STATE} is of another training: starting anew")
    source: SampleSource = samples
    if training.real is not None:
        source = MixedSamples(samples, list(real.values()), training.real.share)
    _run(trainer, source, training.out, console)
    if training.mean and start is not None:
        _to_mean(trainer.network, start[0])
        about["mean"] = True
    path = training.out / f"{training.network}.safetensors"
    save(trainer.network, path, about)
    return path


def _to_mean(network: PointPillars, other: PointPillars) -> None:
    """Moves the weights of a network half of the way to those of another."""
    others = other.state_dict()
    for name, value in network.state_dict().items():
        if value.is_floating_point():
            value.lerp_(others[name].to(value), 0.5)


def about_of(
    training: Training,
    samples: int,
    frames: Sequence[str] = (),
    start: dict[str, object] | None = None,
) -> dict[str, object]:
    """Returns the description in the weights' file: network, recipe, data, and of the start."""
    about: dict[str, object] = {
        "network": training.network,
        "recipe": training.recipe.as_dict(),
        "dataset": Dataset(training.dataset).info.model_dump(),
        "samples": samples,
    }
    if training.real is not None:
        of_real = {"range_m": training.real.range_m, "share": training.real.share}
        about["real"] = {"frames": list(frames), **of_real}
    return about if start is None else {**about, "start": start}


def _run(trainer: Trainer, samples: SampleSource, out: Path, console: Console) -> None:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    losses: list[tuple[float, float]] = []
    saved_s = time.monotonic()
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("training", total=trainer.recipe.steps, completed=trainer.step)
        for step in trainer.run(samples):
            losses = [*losses, (step.score_loss, step.box_loss)][-KEPT_LOSSES:]
            score, box = np.mean(losses, axis=0)
            text = f"loss {score:.3f} score, {box:.3f} box"
            bar.update(task, completed=step.step, description=text)
            if step.step % KEPT_LOSSES == 0 and not console.is_terminal:
                console.print(f"step {step.step}: {text}")
            if time.monotonic() - saved_s > SAVE_EVERY_S:
                trainer.save(out)
                saved_s = time.monotonic()
    trainer.save(out)
