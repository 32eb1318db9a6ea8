"""Tracks detections in KITTI's format, and scores tracks in it against labels.

Without a road map, vehicles move at a constant turn rate, in the frame of the car's poses if there
are any, else in that of its camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from perception.arrays import Floats
from perception.boxes import overlaps
from perception.detector import Vehicles
from perception.tracking.config import TrackingConfig
from perception.tracking.tracker import Tracker
from protocol.config import is_folder
from protocol.errors import ConfigError
from protocol.extras import to_install
from protocol.geometry import SE3
from protocol.messages import ObjectClass
from recording.foreign_scans.poses import lines_of, read_poses
from studies.kitti_files import NO_IMAGE, KittiBoxes, read_boxes, sequences_in, write_tracks
from studies.tracking import Rows, Sequences, TrackScore

IOU_3D = 0.25  # of a match, as AB3DMOT and V2V4Real count it
SAME_M = 4.0  # a track's box in the image is that of the detection nearest to it, if so near
CLASSES = {
    "Car": ObjectClass.CAR,
    "Van": ObjectClass.CAR,
    "Truck": ObjectClass.TRUCK,
    "Bus": ObjectClass.TRUCK,
    "Tram": ObjectClass.TRUCK,
    "Cyclist": ObjectClass.TWO_WHEELER,
    "Pedestrian": ObjectClass.PEDESTRIAN,
    "Person": ObjectClass.PEDESTRIAN,
}
"""The tracker's class of KITTI's types; any other one is a car."""
_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x forward from camera
_MATRIX_WORDS = 12


def track_files(
    folder: Path, out: Path, poses: Path | None, rate_hz: float, config: TrackingConfig
) -> list[Path]:
    """Tracks the detections of each sequence; returns the files that were written.

    Args:
        folder: a file of detections for each sequence.
        out: the folder for tracks, made if missing; files of the same names are replaced.
        poses: of the car, for one sequence a file, else a folder with a file for each.
        rate_hz: frames a second.
        config: of the tracker.

    Raises:
        ConfigError: a file cannot be read or written, or has too few poses.
    """
    files = sequences_in(folder)
    if out.resolve() == folder.resolve():
        raise ConfigError(f"--out {out}: must be another folder than that of the detections")
    tracked = {}
    for name, file in files.items():
        found = read_boxes(file)
        places = _poses_of(name, poses, alone=len(files) == 1, detections=found)
        tracked[name] = track_sequence(found, places, rate_hz, config)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {out} cannot be made: {error}") from None
    written = [out / f"{name}.txt" for name in tracked]
    for path, tracks in zip(written, tracked.values(), strict=True):
        write_tracks(path, tracks)
    return written


def track_sequence(
    found: KittiBoxes, map_SE3_car: Sequence[SE3], rate_hz: float, config: TrackingConfig
) -> KittiBoxes:
    """Returns the tracks of a sequence, frame by frame, each type tracked by itself.

    Scores beyond 0 to 1 are taken for log odds. A track that coasts keeps its last box in the
    image.

    Args:
        found: detections.
        map_SE3_car: a pose for every frame; none if the car's motion is unknown.
        rate_hz: frames a second.
        config: of the tracker.
    """
    scores = found.scores
    if ((scores < 0) | (scores > 1)).any():
        scores = 1 / (1 + np.exp(-np.clip(scores, -30.0, 30.0)))
    first_id = 1
    parts: list[KittiBoxes] = []
    for kind in sorted(set(found.types)):
        is_kind = found.is_type(kind)
        tracker = Tracker(config, first_id=first_id)
        images: dict[int, Floats] = {}
        for frame in range(int(found.frames.max(initial=-1)) + 1):
            here = np.flatnonzero(is_kind & (found.frames == frame))
            pose = map_SE3_car[frame] if map_SE3_car else SE3.identity()
            seen = _moved(found.boxes[here], pose)
            classes = np.full(len(here), CLASSES.get(kind, ObjectClass.CAR), np.uint8)
            tracks = tracker.step(
                round(frame * 1e9 / rate_hz), Vehicles.from_lidar(seen, scores[here], classes)
            )
            _remember(images, tracks.track_ids.tolist(), tracks.boxes, seen, found.images[here])
            ids = tracks.track_ids
            parts.append(
                KittiBoxes(
                    frames=np.full(len(ids), frame),
                    ids=ids,
                    types=[kind] * len(ids),
                    boxes=_moved(tracks.boxes, pose.inverse()),
                    images=_images(images, ids.tolist()),
                    scores=tracks.scores,
                )
            )  # fmt: skip
            first_id = max(first_id, int(ids.max(initial=0)) + 1)
    return _sorted(parts) if parts else found


def _moved(boxes: Floats, dst_SE3_src: SE3) -> Floats:
    """Returns boxes (N, 7) in another frame, whose level may differ a little."""
    heading = np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(len(boxes))])
    turned = heading @ dst_SE3_src.rotation.T
    yaw = np.arctan2(turned[:, 1], turned[:, 0])
    return np.column_stack([dst_SE3_src.apply(boxes[:, :3]), boxes[:, 3:6], yaw])


def _remember(
    images: dict[int, Floats], ids: list[int], tracks: Floats, seen: Floats, of_seen: Floats
) -> None:
    """Assigns tracks the image boxes of the detections nearest to them."""
    if not len(seen):
        return
    apart_m = np.linalg.norm(tracks[:, None, :2] - seen[None, :, :2], axis=2)
    for track, row in zip(ids, apart_m, strict=True):
        if row.min() <= SAME_M:
            images[track] = of_seen[row.argmin()]


def _images(images: dict[int, Floats], ids: list[int]) -> Floats:
    return np.array([images.get(one, NO_IMAGE) for one in ids], np.float64).reshape(-1, 4)


def _sorted(parts: list[KittiBoxes]) -> KittiBoxes:
    """Concatenates parts, sorted by frame and id."""
    frames, ids, boxes, images, scores = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("frames", "ids", "boxes", "images", "scores")
    )
    types = [kind for part in parts for kind in part.types]
    order = np.lexsort((ids, frames))
    return KittiBoxes(
        frames[order], ids[order], [types[n] for n in order], boxes[order], images[order],
        scores[order],
    )  # fmt: skip


def _poses_of(name: str, path: Path | None, *, alone: bool, detections: KittiBoxes) -> list[SE3]:
    """Returns `map_SE3_car` of each frame of a sequence; none without a path."""
    if path is None:
        return []
    file = path / f"{name}.txt" if is_folder(path) else path
    if not is_folder(path) and not alone:
        raise ConfigError(
            f"--poses {path}: of several sequences, must be a folder with a file each"
        )
    rows = read_poses(file)
    if len(rows) != 1:
        raise ConfigError(f"{file}: must hold the poses of one car")
    poses = [SE3.from_pose(row) for row in next(iter(rows.values())).poses]
    needed = int(detections.frames.max(initial=-1)) + 1
    if len(poses) < needed:
        raise ConfigError(f"{file}: holds {len(poses)} poses for {needed} frames")
    lines = (line.split() for line in lines_of(file) if line.strip())
    if len(next(lines, [])) == _MATRIX_WORDS:  # of the camera, as in KITTI's odometry
        turn = SE3(_CAMERA, np.zeros(3))
        poses = [turn @ one @ turn.inverse() for one in poses]
    return poses


Compared = tuple[int, list[int], list[int], npt.ArrayLike]
"""A frame, the ids of vehicles and tracks, their similarity matrix."""


@dataclass(frozen=True, slots=True)
class KittiScore:
    """Tracking measures against labels of one type, by 3D IoU.

    `image_rules` is whether KITTI's rules were applied: vans, boxes that are far occluded or lower
    than 25 px, and those in areas that are not labelled are neither true nor false.
    """

    kind: str
    score: TrackScore
    image_rules: bool

    def as_json(self) -> dict[str, Any]:
        """Returns the measures by stable keys; shares are from 0 to 1."""
        rules = "kitti" if self.image_rules else "all boxes"
        return {**asdict(self.score), "type": self.kind, "iou_3d": IOU_3D, "rules": rules}

    def as_text(self) -> Rows:
        """Returns the measures by readable names."""
        rules = "KITTI's" if self.image_rules else "all boxes count"
        return (*self.score.as_text(), ("rules", rules))


def score_files(tracks: Path, truth: Path, kind: str = "Car") -> KittiScore:
    """Scores the sequences of a folder of tracks against the labels of the same names.

    Labels without a sequence of tracks are ignored.

    Raises:
        ConfigError: a file cannot be read, or is missing.
    """
    try:
        import motrics  # noqa: F401
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"--tracks needs {error.name} (extra `study`): {to_install('study')}"
        ) from None
    labels, together = sequences_in(truth), Sequences([], [], [], [])
    files = sequences_in(tracks)
    missing = [name for name in files if name not in labels]
    if missing:
        raise ConfigError(f"--truth {truth}: has no {missing[0]}.txt")
    found = {name: read_boxes(file) for name, file in files.items()}
    image_rules = all(one.has_images for one in found.values())
    for number, (name, boxes) in enumerate(found.items()):
        if image_rules:
            compared = _by_image_rules(files[name], labels[name], kind)
        else:
            compared = _all_boxes(boxes, read_boxes(labels[name]), kind)
        boxes_named = zip(boxes.frames.tolist(), boxes.ids.tolist(), strict=True)
        scores = dict(zip(boxes_named, boxes.scores.tolist(), strict=True))
        for frame, ids, track_ids, similarity in compared:
            together.vehicles.append([_unique(number, one) for one in ids])
            together.tracks.append([_unique(number, one) for one in track_ids])
            together.similarity.append(np.array(similarity).reshape(len(ids), len(track_ids)))
            together.scores.append(np.array([scores[frame, one] for one in track_ids]))
    return KittiScore(kind, TrackScore.of(together, IOU_3D), image_rules)


def _unique(sequence: int, track: int) -> int:
    return sequence << 32 | track


def _by_image_rules(tracks: Path, labels: Path, kind: str) -> Iterator[Compared]:
    """Yields frames filtered as by KITTI's public evaluation code."""
    import motrics

    gt, ignored = motrics.load_kitti_3d_gt(labels)
    found = motrics.load_kitti_3d(tracks)
    sides = motrics.preprocess_kitti_3d(
        gt, found, kind.lower(), ignore_regions=ignored, iou_threshold=IOU_3D
    )
    return zip(sorted({*gt, *found, *ignored}), *sides, strict=True)


def _all_boxes(tracks: KittiBoxes, labels: KittiBoxes, kind: str) -> Iterator[Compared]:
    """Yields frames with all boxes of a type."""
    for frame in sorted({*tracks.frames.tolist(), *labels.frames.tolist()}):
        (ids, truth), (track_ids, boxes) = (
            (one.ids[chosen].tolist(), one.boxes[chosen])
            for one in (labels, tracks)
            for chosen in (np.flatnonzero((one.frames == frame) & one.is_type(kind)),)
        )
        yield frame, ids, track_ids, overlaps(truth, boxes)[1]
