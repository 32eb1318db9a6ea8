"""Windows as the network takes them, many at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from perception.pillars.voxels import Pillars


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """See `PointPillars.forward`."""

    features: Tensor
    pillar: Tensor
    cell: Tensor
    shape: Tensor

    @classmethod
    def of(cls, windows: Sequence[Pillars], size: tuple[int, int], device: torch.device) -> Batch:
        """Puts windows of one size together, rows and columns."""
        places = size[0] * size[1]
        first = np.cumsum([0, *(len(w.cell) for w in windows)])
        pillar = [w.pillar + at for w, at in zip(windows, first[:-1], strict=True)]
        cell = [w.cell + number * places for number, w in enumerate(windows)]
        return cls(
            torch.from_numpy(np.concatenate([w.features for w in windows])).to(device),
            torch.from_numpy(np.concatenate(pillar)).to(device),
            torch.from_numpy(np.concatenate(cell)).to(device),
            torch.tensor([len(windows), *size]),
        )
