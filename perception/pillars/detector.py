"""PointPillars as a detector: windows over the points, inference, duplicates suppressed.

`Engine` runs a network: norms are folded into the layers, on request it computes in bfloat16.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d
from torch.nn.utils.fusion import fuse_conv_bn_eval

from perception.arrays import Bytes, Floats, Floats32, Ints
from perception.boxes import suppress
from perception.config import PillarsDetection
from perception.detector import Cloud, Stage, Vehicles, untimed
from perception.map_height import TRUSTED_M
from perception.pillars.config import STRIDE
from perception.pillars.hidden_ground import LOWER_M, STANDS, with_lower
from perception.pillars.network import BOX_TERMS, PointPillars, boxes_of, middle_of
from perception.pillars.seen_side import behind_their_points
from perception.pillars.weights import network_of
from perception.pillars.windows import Window, cover, known_of
from perception.roadway import Roadway, merge
from perception.solid import solid_of

_MOST = 500  # anchors of a window that are considered


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Which pillars stand in a window, and in which of its cells (K,), rows of y first."""

    pillar: Ints
    cell: Ints


class Engine:
    """Inference with one network; `half` computes in bfloat16."""

    def __init__(self, network: PointPillars, device: torch.device, *, half: bool) -> None:
        self.config = network.config
        self.device = device
        self._type = torch.bfloat16 if half else torch.float32
        network.eval().requires_grad_(requires_grad=False)
        self._weight, self._bias = _fold(network)
        for part in (*network.blocks, *network.ups):
            assert isinstance(part, nn.Sequential)
            _fuse(part)
        network = network.to(device, self._type)
        weight = torch.cat([network.score.weight, network.box.weight]).flatten(1)
        shares = weight.split(self.config.up_channels, 1)
        self._blocks = [_layers(block) for block in network.blocks]
        self._ups = [
            _Up(up[0], share.T.contiguous()) for up, share in zip(network.ups, shares, strict=True)
        ]
        self._bias_of_head = torch.cat([network.score.bias, network.box.bias])
        self._canvas = torch.zeros(0, self.config.pillar_channels, dtype=self._type, device=device)

    def encode(self, points: Floats32, height_m: Floats32, window: Window) -> tuple[Tensor, Ints]:
        """Encodes the pillars of a window: their features (P, C) and cells (P,)."""
        known, cells = known_of(points, height_m, window, self.config, self._weight, self._bias)
        return torch.from_numpy(known).to(self.device, self._type), cells

    @torch.inference_mode()
    def ask(
        self, known: Tensor, windows: Sequence[Window], seen: Sequence[Seen], *, min_score: float
    ) -> tuple[Floats, Floats, Bytes, Ints]:
        """Returns boxes (N, 7), z over the road, scores, classes and windows (N,).

        All windows are of one size; `seen` has which of the encoded pillars stand in each, and
        where.
        """
        rows, columns = windows[0].size
        head = self.head(known, seen, (rows, columns)).cpu()
        found = [
            (*self._read(terms, window, min_score), number)
            for number, (terms, window) in enumerate(zip(head, windows, strict=True))
        ]
        boxes, scores, classes, windows_of = zip(*found, strict=True)
        number = np.repeat(windows_of, [len(one) for one in scores])
        return np.concatenate(boxes), np.concatenate(scores), np.concatenate(classes), number

    @torch.inference_mode()
    def head(self, known: Tensor, seen: Sequence[Seen], size: tuple[int, int]) -> Tensor:
        """Returns the output of `PointPillars.forward` for windows of such rows and columns."""
        places = size[0] * size[1]
        cell = np.concatenate([one.cell + n * places for n, one in enumerate(seen)])
        standing = torch.from_numpy(cell).to(self.device)
        pillar = torch.from_numpy(np.concatenate([one.pillar for one in seen])).to(self.device)
        canvas = self._cleared(len(seen) * places)
        canvas.index_copy_(0, standing, known[pillar])
        image = canvas.view(len(seen), *size, -1).permute(0, 3, 1, 2)
        terms = self._bias_of_head.repeat(len(seen), size[0] // STRIDE, size[1] // STRIDE, 1)
        for block, up in zip(self._blocks, self._ups, strict=True):
            for layer in block:
                image = layer(image)
            up.add(image, terms)
        canvas.index_fill_(0, standing, 0)
        return terms.permute(0, 3, 1, 2)

    def _cleared(self, places: int) -> Tensor:
        """Returns an empty canvas (P, C); it is reused, for clearing all of it takes long."""
        if places > len(self._canvas):
            self._canvas = self._canvas.new_zeros(places, self._canvas.shape[1])
        return self._canvas[:places]

    def _read(
        self, terms: Tensor, window: Window, min_score: float
    ) -> tuple[Floats, Floats, Bytes]:
        places = window.rows * window.columns // STRIDE**2
        kinds = self.config.kinds
        logits = terms[:kinds].reshape(-1).float()
        least = float(np.log(min_score / (1 - min_score)))
        place = torch.nonzero(logits >= least).reshape(-1)
        if len(place) > _MOST:
            place = place[torch.topk(logits[place], _MOST).indices]
        kind, cell = place // places, place % places
        predicted = terms.permute(1, 2, 0).reshape(places, -1)[cell, kinds:].float()
        boxes = predicted.view(-1, kinds, BOX_TERMS)[torch.arange(len(cell)), kind]
        middle = middle_of(cell.numpy(), window, self.config)
        scores = torch.sigmoid(logits[place]).double().numpy()
        found = boxes_of(boxes.numpy(), middle, kind.numpy(), self.config)
        return found, scores, self.config.classes()[kind.numpy()]


class _Relu:
    """A convolution and its ReLU, in one pass over the image where PyTorch has oneDNN."""

    def __init__(self, weight: Tensor, bias: Tensor, stride: int = 1) -> None:
        self._weight = weight.contiguous(memory_format=torch.channels_last)
        self._bias = bias
        self._stride = stride
        self._margin = weight.shape[-1] // 2
        self._joined = weight.device.type == "cpu" and torch.backends.mkldnn.is_available()

    def __call__(self, image: Tensor) -> Tensor:
        margin, stride = self._margin, self._stride
        if not self._joined:
            return conv2d(image, self._weight, self._bias, stride, margin).relu_()
        both = torch.ops.mkldnn._convolution_pointwise
        ways = [margin] * 2, [stride] * 2, [1, 1]
        return cast("Tensor", both(image, self._weight, self._bias, *ways, 1, "relu", [], ""))


class _Up:
    """A block's share of the head's output: two products of matrices for each pixel.

    The head is linear in the blocks' outputs together, so that these need not be put side by side,
    nor scaled up before the last product.
    """

    def __init__(self, up: nn.Conv2d | nn.ConvTranspose2d, share: Tensor) -> None:
        self._factor = up.kernel_size[0]
        weight = up.weight if isinstance(up, nn.ConvTranspose2d) else up.weight.transpose(0, 1)
        # (in, out, y, x) as (y * x * out, in, 1, 1)
        weight = weight.permute(0, 2, 3, 1).flatten(1).T[:, :, None, None]
        self._raise = _Relu(weight, _known(up.bias).repeat(self._factor**2))
        self._share = share

    def add(self, image: Tensor, terms: Tensor) -> None:
        """Adds the share of (B, C, H, W) to terms (B, H factor, W factor, terms)."""
        batch, _, rows, columns = image.shape
        factor = self._factor
        raised = self._raise(image).permute(0, 2, 3, 1)
        share = raised.reshape(-1, len(self._share)) @ self._share
        share = share.view(batch, rows, columns, factor, factor, -1).transpose(2, 3)
        terms.view(share.shape).add_(share)


def _layers(block: nn.Module) -> list[_Relu]:
    layers = [layer for layer in block.children() if isinstance(layer, nn.Conv2d)]
    return [_Relu(layer.weight, _known(layer.bias), layer.stride[0]) for layer in layers]


def _known(bias: Tensor | None) -> Tensor:
    assert bias is not None
    return bias


def _fold(network: PointPillars) -> tuple[Floats32, Floats32]:
    """Returns the points' layer with its norm in it: weight (6, C) and bias (C,)."""
    norm = network.norm
    assert norm.running_var is not None
    assert norm.running_mean is not None
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    weight = (network.encode.weight * scale[:, None]).T.detach().contiguous()
    bias = (norm.bias - norm.running_mean * scale).detach()
    return weight.numpy(), bias.numpy()


def _fuse(steps: nn.Sequential) -> None:
    for index in range(len(steps) - 1):
        layer, norm = steps[index], steps[index + 1]
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d) and isinstance(norm, nn.BatchNorm2d):
            is_up = isinstance(layer, nn.ConvTranspose2d)
            steps[index] = fuse_conv_bn_eval(layer, norm, transpose=is_up)
            steps[index + 1] = nn.Identity()


EDGE_M = 3.0  # what lies closer to a window's edge is seen better by the next one
_ASKED = 20_000  # points of a cloud, for how far the map's height is off
AT_ONCE = 8  # windows; bounds the memory that a cloud takes


class PillarsDetector:
    """Detects vehicles by PointPillars in clouds placed on `roadway`."""

    def __init__(
        self, engine: Engine, roadway: Roadway, config: PillarsDetection, *, unmapped: bool = False
    ) -> None:
        self._engine = engine
        self._roadway = roadway
        self._config = config
        self._unmapped = unmapped

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:  # noqa: ARG002 - nothing is drawn
        """See `perception.detector.Detector.detect`."""
        with stage("detect"):
            if not self._unmapped:
                return self._found(cloud, self._config.min_score)
            least = STANDS * self._config.min_score
            on_road, lower = (self._found(cloud, least, lower_m) for lower_m in (0.0, LOWER_M))
            found = with_lower(on_road, lower, *cloud.points_over_road())
            found = found.take(found.scores >= self._config.min_score)
            return found.take(suppress(found.boxes, found.scores, iou=self._config.same_iou))

    def _found(self, cloud: Cloud, least: float, lower_m: float = 0.0) -> Vehicles:
        """Returns the vehicles of this score or a better one on ground so far below the road."""
        parts = [*cloud.near, *cloud.bare]
        points, road_m = merge(parts)
        height_m = points[:, 2] - road_m + np.float32(lower_m)
        windows = cover(
            np.concatenate([np.zeros((0, 3), np.float32), *(part.lowest for part in parts)]),
            self._engine.config.cell_m,
        )
        boxes, scores, classes = self._ask(points, height_m, windows, least)
        kept = suppress(boxes, scores, iou=self._config.same_iou)
        boxes, scores, classes = boxes[kept], scores[kept], classes[kept]
        sizes = np.array([len(part.points) for part in parts], np.int64)
        boxes = behind_their_points(boxes, points, height_m, sizes, cloud.sensors)
        boxes[:, 2] += _ground_at(boxes, points, road_m, self._roadway) - lower_m
        boxes[:, 6] = _headed(boxes[:, 6], self._roadway.yaw_at(boxes))
        found = Vehicles.from_lidar(boxes, scores, classes)
        return solid_of(found, cloud, self._roadway, unmapped=self._unmapped, lower_m=lower_m)

    def _ask(
        self, points: Floats32, height_m: Floats32, windows: list[Window], least: float
    ) -> tuple[Floats, Floats, Bytes]:
        boxes, scores, classes = [np.zeros((0, 7))], [np.zeros(0)], [np.zeros(0, np.uint8)]
        if windows:
            shape = self._engine.config
            around = _around(windows, shape.cell_m)
            known, cells = self._engine.encode(points, height_m, around)
            standing = np.divmod(cells, around.columns)
            for part in _alike(windows):
                seen = [_pillars_in(*standing, around, window, shape.cell_m) for window in part]
                found, score, kinds, number = self._engine.ask(known, part, seen, min_score=least)
                well = _well_inside(found, [part[n] for n in number], shape.cell_m)
                boxes.append(found[well])
                scores.append(score[well])
                classes.append(kinds[well])
        return np.concatenate(boxes), np.concatenate(scores), np.concatenate(classes)


def pillars_detector(
    name: str, config: PillarsDetection, roadway: Roadway, *, unmapped: bool = False
) -> PillarsDetector:
    """Builds `pointpillars` or `pointpillars-full`, with the shipped weights or the user's.

    Raises:
        ConfigError: the weights cannot be used.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    engine = Engine(network_of(name, config), device, half=computes_in_half(device))
    return PillarsDetector(engine, roadway, config, unmapped=unmapped)


def computes_in_half(device: torch.device) -> bool:
    """Whether bfloat16 is a gain: on CPUs that have no instructions for it, it is slow."""
    known = torch.cpu.get_capabilities()
    return device.type != "cpu" or bool(known.get("avx512_bf16") or known.get("amx_bf16"))


def _around(windows: list[Window], cell_m: float) -> Window:
    """Returns a window that holds them all."""
    low = np.min([window.low for window in windows], axis=0)
    high = np.max([window.low + np.array(window.size[::-1]) * cell_m for window in windows], axis=0)
    columns, rows = (int(n) for n in np.round((high - low) / cell_m))
    return Window(low, columns, rows)


def _pillars_in(row: Ints, column: Ints, around: Window, window: Window, cell_m: float) -> Seen:
    """Returns which pillars of the window around others stand in one of them."""
    first_column, first_row = np.round((window.low - around.low) / cell_m).astype(np.int64)
    row, column = row - first_row, column - first_column
    inside = (row >= 0) & (row < window.rows) & (column >= 0) & (column < window.columns)
    pillar = np.flatnonzero(inside)
    return Seen(pillar, row[pillar] * window.columns + column[pillar])


def _alike(windows: list[Window]) -> Iterator[list[Window]]:
    """Yields windows of one size, as many as are asked for at once."""
    windows = sorted(windows, key=lambda window: window.size)
    for _, group in groupby(windows, key=lambda window: window.size):
        alike = list(group)
        for first in range(0, len(alike), AT_ONCE):
            yield alike[first : first + AT_ONCE]


def _well_inside(boxes: Floats, windows: list[Window], cell_m: float) -> np.ndarray:
    low = np.array([window.low for window in windows]).reshape(-1, 2)
    side_m = np.array([w.size[::-1] for w in windows]).reshape(-1, 2) * cell_m
    off = boxes[:, :2] - low
    return np.asarray(((off >= EDGE_M) & (off < side_m - EDGE_M)).all(axis=1))


def _ground_at(boxes: Floats, points: Floats32, road_m: Floats32, roadway: Roadway) -> Floats:
    """Returns the road's height at boxes (N,): the map's, or what points nearby were given for it.

    Points (P, 3) come with the height of the road (P,), see `perception.map_height`.
    """
    ground_m = roadway.height_at(boxes)
    step = max(len(points) // _ASKED, 1)
    asked = points[::step]
    off_m = road_m[::step] - roadway.height_at(asked.astype(np.float64))
    if len(boxes) and (np.abs(off_m) > TRUSTED_M).any():
        nearest = [np.square(asked[:, :2] - box[:2]).sum(axis=1).argmin() for box in boxes]
        ground_m += off_m[nearest]
    return ground_m


def _headed(yaw: Floats, road_yaw: Floats) -> Floats:
    """Turns boxes, whose front is unknown, so that they head along the road."""
    off = (yaw - road_yaw + np.pi / 2) % np.pi - np.pi / 2
    return np.asarray((road_yaw + off + np.pi) % (2 * np.pi) - np.pi)
