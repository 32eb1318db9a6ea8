"""`cpnet train`: from a data set to a file of weights."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from learning.dataset import Dataset
from learning.sights import DatasetSights
from learning.training import Recipe, Trainer
from perception.pillars.config import NETWORKS
from perception.pillars.weights import save
from protocol.errors import ConfigError
from protocol.files import is_file

KEPT_LOSSES = 200  # steps whose mean loss is shown
SAVE_EVERY_S = 60.0


@dataclass(frozen=True, slots=True)
class Training:
    """What is trained, on what, and where the weights and the state go."""

    dataset: Path
    out: Path
    network: str
    recipe: Recipe

    def check(self) -> None:
        """Raises ConfigError if it cannot be done."""
        if self.network not in NETWORKS:
            raise ConfigError(f"network {self.network!r}: allowed are {', '.join(NETWORKS)}")
        least = {"steps": 1, "windows": 1, "cells": 64}
        for name, low in least.items():
            value = getattr(self.recipe, name)
            if value < low or (name == "cells" and value % 8):
                raise ConfigError(f"--{name} {value}: must be at least {low}, cells in steps of 8")
        if is_file(self.out):
            raise ConfigError(f"--out {self.out}: is a file, needs a folder")


def train(training: Training, console: Console) -> Path:
    """Trains, or goes on with what lies in the folder; returns the weights' file.

    Raises:
        ConfigError: the data set or the folder's state cannot be read, or the folder be made.
    """
    training.check()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    sights = DatasetSights(Dataset(training.dataset), "train")
    if not len(sights):
        raise ConfigError(f"dataset {training.dataset}: its training split is empty")
    try:
        training.out.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--out {training.out}: {error}") from None
    trainer = Trainer(NETWORKS[training.network], training.recipe, device)
    if trainer.resume(training.out):
        console.print(f"going on after step {trainer.step}")
    _run(trainer, sights, training.out, console)
    path = training.out / f"{training.network}.safetensors"
    save(trainer.network, path, about_of(training, len(sights)))
    return path


def about_of(training: Training, moments: int) -> dict[str, object]:
    """Returns what the weights' file says of its making."""
    return {
        "network": training.network,
        "recipe": training.recipe.as_dict(),
        "dataset": Dataset(training.dataset).info.model_dump(),
        "moments": moments,
    }


def _run(trainer: Trainer, sights: DatasetSights, out: Path, console: Console) -> None:
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
        for step in trainer.run(sights):
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
