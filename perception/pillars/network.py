"""The PointPillars network: points to pillars, pillars to an image, image to scores and boxes.

After Lang et al. 2019, with changes for CPUs: points are never padded to pillars of a fixed size,
each is encoded once and the maximum taken by pillar; images are channels-last. Boxes are encoded
as residuals against anchors; `Batch` holds many windows as the network takes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from perception.arrays import Floats, Floats32, Ints
from perception.pillars.config import ANCHOR_YAWS, FEATURES, STRIDE, PillarsConfig
from perception.pillars.windows import Pillars, Window

BOX_TERMS = 7
_PRIOR = 0.01  # score of an untrained anchor


class PointPillars(nn.Module):
    """Maps windows to scores (B, K, H, W) and box terms (B, K, 7, H, W) of K kinds of anchors."""

    def __init__(self, config: PillarsConfig) -> None:
        super().__init__()
        self.config = config
        self.encode = nn.Linear(FEATURES, config.pillar_channels, bias=False)
        self.norm = nn.BatchNorm1d(config.pillar_channels, eps=1e-3, momentum=0.01)
        blocks, ups = [], []
        before = config.pillar_channels
        for index, (channels, layers) in enumerate(
            zip(config.channels, config.layers, strict=True)
        ):
            blocks.append(_block(before, channels, layers))
            ups.append(_up(channels, config.up_channels, 2**index))
            before = channels
        self.blocks, self.ups = nn.ModuleList(blocks), nn.ModuleList(ups)
        wide = config.up_channels * len(blocks)
        self.score = nn.Conv2d(wide, config.kinds, 1)
        self.box = nn.Conv2d(wide, config.kinds * BOX_TERMS, 1)
        nn.init.constant_(
            _bias(self.score), -float(torch.log(torch.tensor(1 / _PRIOR - 1, device="cpu")))
        )

    def forward(self, features: Tensor, pillar: Tensor, cell: Tensor, shape: Tensor) -> Tensor:
        """Returns the head's output (B, K + 7 K, H / 2, W / 2).

        Args:
            features: of the points (N, 6).
            pillar: which pillar each point belongs to (N,).
            cell: where each pillar stands in the batch of images, flat (P,).
            shape: windows, rows and columns (3,).
        """
        return self.head(self.image(self.pillars(features, pillar, len(cell)), cell, shape))

    def pillars(self, features: Tensor, pillar: Tensor, count: int) -> Tensor:
        """Returns the features of each pillar (P, C)."""
        points = torch.relu(self.norm(self.encode(features)))
        empty = points.new_zeros(count, points.shape[1])
        return empty.scatter_reduce(0, pillar[:, None].expand_as(points), points, "amax")

    @staticmethod
    def image(pillars: Tensor, cell: Tensor, shape: Tensor) -> Tensor:
        """Scatters pillars to the pseudo-image (B, C, H, W), channels-last."""
        windows, rows, columns = (int(n) for n in shape)
        flat = pillars.new_zeros(windows * rows * columns, pillars.shape[1])
        flat = flat.index_copy(0, cell, pillars)
        return flat.view(windows, rows, columns, -1).permute(0, 3, 1, 2)

    def head(self, image: Tensor) -> Tensor:
        """Returns scores (before the sigmoid) and box terms of all anchors."""
        parts = []
        for block, up in zip(self.blocks, self.ups, strict=True):
            image = block(image)
            parts.append(up(image))
        both = torch.cat(parts, 1)
        return torch.cat([self.score(both), self.box(both)], 1)


def lay_channels_last(network: nn.Module) -> None:
    """Lays kernels out as images are, which is what CPUs compute fastest."""
    for parameter in network.parameters():
        if parameter.dim() == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)


def _block(before: int, channels: int, layers: int) -> nn.Sequential:
    steps = [*_step(nn.Conv2d(before, channels, 3, STRIDE, 1, bias=False))]
    for _ in range(layers):
        steps += _step(nn.Conv2d(channels, channels, 3, 1, 1, bias=False))
    return nn.Sequential(*steps)


def _up(channels: int, wide: int, factor: int) -> nn.Sequential:
    if factor == 1:
        return nn.Sequential(*_step(nn.Conv2d(channels, wide, 1, bias=False)))
    return nn.Sequential(*_step(nn.ConvTranspose2d(channels, wide, factor, factor, bias=False)))


def _step(layer: nn.Conv2d | nn.ConvTranspose2d) -> list[nn.Module]:
    return [
        layer,
        nn.BatchNorm2d(layer.out_channels, eps=1e-3, momentum=0.01),
        nn.ReLU(inplace=True),
    ]


def _bias(layer: nn.Conv2d) -> Tensor:
    bias = layer.bias
    assert bias is not None
    return bias


def middle_of(place: Ints, window: Window, config: PillarsConfig) -> Floats:
    """Returns the middles x, y (K, 2) of output cells, numbered along x first."""
    row, column = np.divmod(place, window.columns // STRIDE)
    return window.low + (np.stack([column, row], -1) + 0.5) * STRIDE * config.cell_m


def terms_of(boxes: Floats, middle: Floats, kind: Ints, config: PillarsConfig) -> Floats32:
    """Encodes boxes (N, 7), z over the road, as terms (N, 7) of anchors at middles (N, 2).

    `kind` (N,) is that of the anchor: its number in the configuration, once along x, once along y.
    The yaw's term is the angle to the anchor within a quarter turn either way: a box has no front.
    """
    sizes_m = config.sizes_m()[kind]
    diagonal_m = np.hypot(sizes_m[:, 0], sizes_m[:, 1])
    off = (boxes[:, :2] - middle) / diagonal_m[:, None]
    rise = (boxes[:, 2] - config.middles_m()[kind]) / sizes_m[:, 2]
    sizes = np.log(boxes[:, 3:6] / sizes_m)
    turn = boxes[:, 6] - kind % ANCHOR_YAWS * (np.pi / ANCHOR_YAWS)
    turn = (turn + np.pi / 2) % np.pi - np.pi / 2
    return np.column_stack([off, rise, sizes, turn]).astype(np.float32)


def boxes_of(terms: Floats32, middle: Floats, kind: Ints, config: PillarsConfig) -> Floats:
    """Decodes boxes (N, 7), z over the road, from terms (N, 7); see `terms_of`."""
    sizes_m = config.sizes_m()[kind]
    diagonal_m = np.hypot(sizes_m[:, 0], sizes_m[:, 1])
    terms = terms.astype(np.float64)
    xy = middle + terms[:, :2] * diagonal_m[:, None]
    z = config.middles_m()[kind] + terms[:, 2] * sizes_m[:, 2]
    sizes = np.exp(np.clip(terms[:, 3:6], -2, 2)) * sizes_m
    yaw = terms[:, 6] + kind % ANCHOR_YAWS * (np.pi / ANCHOR_YAWS)
    return np.column_stack([xy, z, sizes, yaw])


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """See `PointPillars.forward`."""

    features: Tensor
    pillar: Tensor
    cell: Tensor
    shape: Tensor

    @classmethod
    def of(cls, windows: Sequence[Pillars], size: tuple[int, int], device: torch.device) -> Batch:
        """Batches windows of one size, rows and columns."""
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
