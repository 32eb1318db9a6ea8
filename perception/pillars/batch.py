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
    def of(cls, windows: Sequence[Pillars], cells: int, device: torch.device) -> Batch:
        """Puts windows of `cells` x `cells` pillars together."""
        first = np.cumsum([0, *(len(w.cell) for w in windows)])
        pillar = [w.pillar + at for w, at in zip(windows, first[:-1], strict=True)]
        cell = [w.cell + number * cells**2 for number, w in enumerate(windows)]
        return cls(
            torch.from_numpy(np.concatenate([w.features for w in windows])).to(device),
            torch.from_numpy(np.concatenate(pillar)).to(device),
            torch.from_numpy(np.concatenate(cell)).to(device),
            torch.tensor([len(windows), cells, cells]),
        )
