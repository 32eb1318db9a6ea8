"""Boxes in the text files of KITTI's tracking benchmark: a file a sequence, a line a box.

Two formats are read, words separated by spaces or commas:

- labels and results, 17 or 18 words: frame, id, type, truncation, occlusion, alpha, the box in the
  image (left, top, right, bottom in px), height, width, length, x, y, z of the middle of the
  box's bottom in the camera's frame, rotation_y, and of results the score;
- AB3DMOT's detections (Weng et al. 2020), 15 words: frame, type as a number, the box in the image,
  score, height, width, length, x, y, z, rotation_y, alpha.

The camera's frame has x to the right, y down, z forward; boxes are handed on in a frame with x
forward, y left, z up at the same place.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perception.arrays import Bools, Floats, Ints
from protocol.config import is_folder
from protocol.errors import ConfigError
from protocol.geometry import wrap_angle
from recording.foreign_scans.poses import lines_of, numbers_of

_LABEL, _RESULT, _DETECTION = 17, 18, 15
_TYPES = {1: "Pedestrian", 2: "Car", 3: "Cyclist"}  # AB3DMOT's numbers
_IGNORED = "DontCare"
MAX_FRAME = 1_000_000
MAX_M = 1e6
NO_IMAGE = (-1.0, -1.0, -1.0, -1.0)


@dataclass(frozen=True, slots=True, eq=False)
class KittiBoxes:
    """The boxes (N) of a sequence, in the order of its lines.

    `boxes` (N, 7) are as in `perception.detector.Vehicles`, x forward, y left, z up; `images`
    (N, 4) are left, top, right, bottom in px, all -1 where a box has none. Detections have the id
    -1, labels the score 1.
    """

    frames: Ints
    ids: Ints
    types: list[str]
    boxes: Floats
    images: Floats
    scores: Floats

    @property
    def has_images(self) -> bool:
        """Whether every box has one in the image."""
        return bool((self.images[:, 3] > self.images[:, 1]).all())

    def is_type(self, kind: str) -> Bools:
        """Marks the boxes of a type."""
        return np.array([one == kind for one in self.types], np.bool_)


def sequences_in(folder: Path) -> dict[str, Path]:
    """Returns the files of a folder by the names of their sequences.

    Raises:
        ConfigError: there is no such folder, or no .txt file in it.
    """
    files = sorted(folder.glob("*.txt")) if is_folder(folder) else []
    if not files:
        raise ConfigError(f"{folder}: must be a folder with a .txt file for each sequence")
    return {file.stem: file for file in files}


def read_boxes(path: Path) -> KittiBoxes:
    """Reads a sequence.

    Raises:
        ConfigError: the file cannot be read, or a line of it; names file and line.
    """
    types: list[str] = []
    rows: list[list[float]] = []
    for number, line in enumerate(lines_of(path), 1):
        words = line.replace(",", " ").split()
        if words and words[2:3] != [_IGNORED]:
            kind, row = _line(words, f"{path}: line {number}")
            types.append(kind)
            rows.append(row)
    table = np.array(rows, np.float64).reshape(-1, 14)
    height, width, length, x, y, z, turn = table[:, 6:13].T
    yaw = wrap_angle(-turn - np.pi / 2)
    return KittiBoxes(
        frames=table[:, 0].astype(np.int64),
        ids=table[:, 1].astype(np.int64),
        types=types,
        boxes=np.column_stack([z, -x, height / 2 - y, length, width, height, yaw]),
        images=table[:, 2:6],
        scores=table[:, 13],
    )


def _line(words: list[str], where: str) -> tuple[str, list[float]]:
    """Returns a line's type, and frame, id, image box, height to rotation_y, score (14 numbers)."""
    if len(words) == _DETECTION:
        frame, kind, *image, score, h, w, length, x, y, z, turn, _ = numbers_of(words, where)
        if kind not in _TYPES:
            raise ConfigError(f"{where}: type {kind:g} must be one of 1, 2, 3")
        name, row = _TYPES[int(kind)], [frame, -1.0, *image, h, w, length, x, y, z, turn, score]
    elif len(words) in (_LABEL, _RESULT):
        name = words[2]
        frame, track, _, _, _, *rest = numbers_of(words[:2] + words[3:], where)
        row = [frame, track, *rest[:11], rest[11] if len(words) == _RESULT else 1.0]
    else:
        raise ConfigError(f"{where}: has {len(words)} words, needs 15, 17 or 18")
    if not (0 <= row[0] <= MAX_FRAME and row[0] == int(row[0])):
        raise ConfigError(f"{where}: frame {row[0]:g} must be a whole number up to {MAX_FRAME}")
    if min(row[6:9]) <= 0 or max(map(abs, row[6:12])) > MAX_M:
        raise ConfigError(f"{where}: a box must have a size, and lie within {MAX_M:g} m")
    return name, row


def write_tracks(path: Path, tracks: KittiBoxes) -> None:
    """Writes a sequence's tracks as KITTI's results.

    Raises:
        ConfigError: the file cannot be written.
    """
    try:
        path.write_text("".join(f"{line}\n" for line in _lines(tracks)), "utf-8")
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from None


def _lines(tracks: KittiBoxes) -> Iterable[str]:
    x_m, y_m, z_m, length, width, height, yaw = tracks.boxes.T
    turn = wrap_angle(-yaw - np.pi / 2)
    alpha = wrap_angle(turn - np.arctan2(-y_m, x_m))
    bottom = np.column_stack([-y_m, height / 2 - z_m, x_m])
    numbers = np.column_stack(
        [alpha, tracks.images, height, width, length, bottom, turn, tracks.scores]
    )
    heads = zip(tracks.frames.tolist(), tracks.ids.tolist(), tracks.types, strict=True)
    for (frame, track, kind), row in zip(heads, numbers.tolist(), strict=True):
        yield f"{frame} {track} {kind} -1 -1 " + " ".join(f"{value:.4f}" for value in row)
