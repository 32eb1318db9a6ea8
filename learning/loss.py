"""What the network is punished for (Lang et al. 2019, after RetinaNet and SECOND)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, smooth_l1_loss

from learning.targets import Targets
from perception.pillars.config import ANCHOR_YAWS
from perception.pillars.network import BOX_TERMS

ALPHA, GAMMA = 0.25, 2.0
BOX_WEIGHT = 2.0
_BETA = 1 / 9


@dataclass(frozen=True, slots=True, eq=False)
class Losses:
    """Both parts, by vehicle anchor; their sum is what is lowered."""

    score: Tensor
    box: Tensor

    @property
    def total(self) -> Tensor:
        """The weighted sum."""
        return self.score + BOX_WEIGHT * self.box


def losses_of(head: Tensor, targets: list[Targets], device: torch.device) -> Losses:
    """Compares the head's output (B, 16, H, W) with the targets of each window."""
    windows = len(head)
    logits = head[:, :ANCHOR_YAWS].reshape(windows, -1).float()
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
    terms = head[:, ANCHOR_YAWS:].reshape(windows, ANCHOR_YAWS, BOX_TERMS, cells)
    by_anchor = terms.permute(0, 1, 3, 2).reshape(-1, BOX_TERMS)
    anchors = ANCHOR_YAWS * cells
    places = [number * anchors + t.place.astype(np.int64) for number, t in enumerate(targets)]
    said = by_anchor[torch.from_numpy(np.concatenate(places)).to(device)].float()
    wanted = torch.from_numpy(np.concatenate([t.terms for t in targets])).to(device)
    off = said[:, :6] - wanted[:, :6]
    turn = torch.sin(said[:, 6] - wanted[:, 6])
    both = torch.cat([off, turn[:, None]], 1)
    return smooth_l1_loss(both, torch.zeros_like(both), beta=_BETA, reduction="sum")
