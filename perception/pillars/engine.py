"""The network made ready to be asked: norms folded into the layers, half precision if wanted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from perception.arrays import Floats, Ints
from perception.pillars.anchors import boxes_of, middle_of
from perception.pillars.batch import Batch
from perception.pillars.config import ANCHOR_YAWS, STRIDE
from perception.pillars.network import BOX_TERMS, PointPillars, lay_channels_last
from perception.pillars.voxels import Pillars, Window

_MOST = 500  # anchors of a window that are looked at


class Engine:
    """Asks one network; `half` computes in bfloat16."""

    def __init__(self, network: PointPillars, device: torch.device, *, half: bool) -> None:
        self.config = network.config
        self.device = device
        self._type = torch.bfloat16 if half else torch.float32
        network.eval().requires_grad_(requires_grad=False)
        self._weight, self._bias = _fold(network)
        for part in (*network.blocks, *network.ups):
            assert isinstance(part, nn.Sequential)
            _fuse(part)
        self._weight, self._bias = self._weight.to(device), self._bias.to(device)
        self._canvas = torch.zeros(
            0, network.config.pillar_channels, dtype=self._type, device=device
        )
        self._network = network.to(device, self._type)
        lay_channels_last(self._network)

    @torch.inference_mode()
    def ask(
        self, windows: Sequence[Window], pillars: Sequence[Pillars], *, min_score: float
    ) -> tuple[Floats, Floats, Ints]:
        """Returns boxes (K, 7), z over the road, scores (K,) and the window (K,) of each.

        All windows are of one size.
        """
        head = self._head(Batch.of(pillars, windows[0].size, self.device)).float().cpu()
        found = [
            (*self._read(terms, window, min_score), number)
            for number, (terms, window) in enumerate(zip(head, windows, strict=True))
        ]
        number = np.repeat([n for *_, n in found], [len(scores) for _, scores, _ in found])
        boxes = np.concatenate([boxes for boxes, _, _ in found])
        return boxes, np.concatenate([scores for _, scores, _ in found]), number

    def _head(self, batch: Batch) -> Tensor:
        points = torch.addmm(self._bias, batch.features, self._weight).relu_()
        empty = points.new_zeros(len(batch.cell), points.shape[1])
        index = batch.pillar[:, None].expand_as(points)
        known = empty.scatter_reduce_(0, index, points, "amax").to(self._type)
        windows, rows, columns = (int(n) for n in batch.shape)
        canvas = self._cleared(windows * rows * columns)
        canvas[batch.cell] = known
        image = canvas.view(windows, rows, columns, -1).permute(0, 3, 1, 2)
        head: Tensor = self._network.head(image)
        canvas[batch.cell] = 0
        return head

    def _cleared(self, places: int) -> Tensor:
        """Returns an empty canvas (P, C); it is kept, for to clear all of it takes long."""
        if places > len(self._canvas):
            self._canvas = self._canvas.new_zeros(places, self._canvas.shape[1])
        return self._canvas[:places]

    def _read(self, terms: Tensor, window: Window, min_score: float) -> tuple[Floats, Floats]:
        places = window.rows * window.columns // STRIDE**2
        logits = terms[:ANCHOR_YAWS].reshape(-1)
        least = float(np.log(min_score / (1 - min_score)))
        place = torch.nonzero(logits >= least).reshape(-1)
        if len(place) > _MOST:
            place = place[torch.topk(logits[place], _MOST).indices]
        kind, cell = place // places, place % places
        boxes = terms[ANCHOR_YAWS:].reshape(ANCHOR_YAWS, BOX_TERMS, -1)[kind, :, cell]
        middle = middle_of(cell.numpy(), window, self.config)
        scores = torch.sigmoid(logits[place]).double().numpy()
        return boxes_of(boxes.numpy(), middle, kind.numpy(), self.config), scores


def _fold(network: PointPillars) -> tuple[Tensor, Tensor]:
    """Returns the points' layer with its norm in it: weight (6, C) and bias (C,)."""
    norm = network.norm
    assert norm.running_var is not None
    assert norm.running_mean is not None
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    weight = (network.encode.weight * scale[:, None]).T.detach().contiguous()
    return weight, (norm.bias - norm.running_mean * scale).detach()


def _fuse(steps: nn.Sequential) -> None:
    for index in range(len(steps) - 1):
        layer, norm = steps[index], steps[index + 1]
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d) and isinstance(norm, nn.BatchNorm2d):
            is_up = isinstance(layer, nn.ConvTranspose2d)
            steps[index] = fuse_conv_bn_eval(layer, norm, transpose=is_up)
            steps[index + 1] = nn.Identity()
