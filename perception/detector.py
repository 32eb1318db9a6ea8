"""What every detector is given and gives; edge and agents share them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from perception.arrays import Floats
from perception.config import DetectionConfig
from perception.roadway import Placed, Roadway
from perception.vehicles import Vehicles


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points in the map frame, with the road's height below each, in the parts they came in.

    `near` still have the ground in them, `bare` were freed of it by those who sent them. `sensors`
    (S, 3) are the places the points were seen from.
    """

    near: Sequence[Placed]
    bare: Sequence[Placed]
    sensors: Floats


class Stage(Protocol):
    """Times a stage by its name."""

    def __call__(self, name: str) -> AbstractContextManager[None]:
        """Returns what to enter for the stage's time."""


def untimed(name: str) -> AbstractContextManager[None]:  # noqa: ARG001 - as `Stage` has it
    """Times nothing."""
    return nullcontext()


class Detector(Protocol):
    """Finds vehicles; keeps nothing from one cloud to the next."""

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:
        """Returns the vehicles in a cloud, map frame; the same for the same cloud and state."""


DetectorMaker = Callable[[DetectionConfig, Roadway], Detector]
