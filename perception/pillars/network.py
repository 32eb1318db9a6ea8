"""The network: points to pillars, pillars to an image, the image to scores and boxes.

After Lang et al. 2019, with what a CPU asks for: points are never padded to pillars of a fixed
size, each is encoded once and the maximum taken by pillar; images are channels-last.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from perception.pillars.config import ANCHOR_YAWS, FEATURES, STRIDE, PillarsConfig

BOX_TERMS = 7
_PRIOR = 0.01  # score of an untrained anchor


class PointPillars(nn.Module):
    """Maps a batch of windows to scores (B, 2, H, W) and box terms (B, 2, 7, H, W)."""

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
        self.score = nn.Conv2d(wide, ANCHOR_YAWS, 1)
        self.box = nn.Conv2d(wide, ANCHOR_YAWS * BOX_TERMS, 1)
        nn.init.constant_(
            _bias(self.score), -float(torch.log(torch.tensor(1 / _PRIOR - 1, device="cpu")))
        )

    def forward(self, features: Tensor, pillar: Tensor, cell: Tensor, shape: Tensor) -> Tensor:
        """Returns the head's output (B, 2 + 14, H / 2, W / 2).

        Args:
            features: of the points (N, 6).
            pillar: which pillar each point belongs to (N,).
            cell: where each pillar stands in the batch of images, flat (P,).
            shape: windows, rows and columns (3,).
        """
        return self.head(self.image(self.pillars(features, pillar, len(cell)), cell, shape))

    def pillars(self, features: Tensor, pillar: Tensor, count: int) -> Tensor:
        """Returns what is known of each pillar (P, C)."""
        points = torch.relu(self.norm(self.encode(features)))
        empty = points.new_zeros(count, points.shape[1])
        return empty.scatter_reduce(0, pillar[:, None].expand_as(points), points, "amax")

    @staticmethod
    def image(pillars: Tensor, cell: Tensor, shape: Tensor) -> Tensor:
        """Puts pillars where they stand: (B, C, H, W), channels-last."""
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
