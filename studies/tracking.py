"""Tracking measures: HOTA, IDF1, MOTA, AMOTA, and those of coasting tracks.

The counts are those of `motrics`, whose results are TrackEval's; only the mean over recalls of
AMOTA and sAMOTA is formed here. From top to bottom: the frames that are compared, similarity, the
measures of any tracks, those of tracks with the time that they coast.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from perception.arrays import Bools, Floats
from perception.boxes import overlaps
from studies.page.model import DASH

MATCH_M = 2.0  # centres farther apart are of two vehicles
_ANY = 1e-9  # least similarity of a pair: its centres are less than `MATCH_M` apart
RECALLS = 40  # levels over which AMOTA is the mean
HIDDEN_S = 5.0
COASTED_S = 3.0
_SAME_S = 0.01  # times that differ by less are the same

Similarity = Callable[[Floats, Floats], Floats]
Rows = tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """The vehicles (N) of a frame, and the boxes (M) of tracks.

    Boxes are (N, 7) and (M, 7), as in `perception.detector.Vehicles`, speeds are in m/s. Those
    vehicles that are `due` (N,) are to be tracked; a box of another one is neither true nor false,
    nor is one of no vehicle unless it is `inside` (M,).
    `coasted_s` (M,) is the time since a sensor last saw a track's vehicle, 0 in a frame with it.
    """

    time_s: float
    vehicles: Sequence[Hashable]
    vehicle_boxes: Floats
    vehicle_speeds_mps: Floats
    due: Bools
    tracks: Sequence[Hashable]
    boxes: Floats
    speeds_mps: Floats
    scores: Floats
    coasted_s: Floats
    inside: Bools


def centre_similarity(vehicles: Floats, boxes: Floats) -> Floats:
    """Returns (N, M) 1 where centres from above are the same, falling to 0 at `MATCH_M`."""
    apart_m = np.linalg.norm(vehicles[:, None, :2] - boxes[None, :, :2], axis=2)
    return np.asarray(np.maximum(1.0 - apart_m / MATCH_M, 0.0))


def bev_iou(vehicles: Floats, boxes: Floats) -> Floats:
    """Returns the intersection over union (N, M) from above."""
    return overlaps(vehicles, boxes)[0]


def pairs_of(similarity: Floats, least: float = _ANY) -> list[tuple[int, int]]:
    """Returns the pairs (vehicle, box) whose similarities have the largest sum."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-np.where(similarity >= least, similarity, 0.0))
    both = zip(rows.tolist(), columns.tolist(), strict=True)
    return [(row, column) for row, column in both if similarity[row, column] >= least]


@dataclass(frozen=True, slots=True, eq=False)
class Sequences:
    """Sequences to compare: by frame, ids of vehicles and tracks, similarity, scores of boxes."""

    vehicles: list[list[int]]
    tracks: list[list[int]]
    similarity: list[npt.NDArray[np.float64]]
    scores: list[Floats]

    @classmethod
    def of(cls, frames: Iterable[TrackedFrame], similarity: Similarity) -> Sequences:
        """Compares the vehicles that are due with the boxes that could be theirs."""
        numbers: dict[tuple[str, Hashable], int] = {}
        result = cls([], [], [], [])
        for frame in frames:
            near = centre_similarity(frame.vehicle_boxes, frame.boxes)
            counts = frame.inside.copy()
            for vehicle, box in pairs_of(near):
                counts[box] = frame.due[vehicle]
            kept = np.flatnonzero(counts).tolist()
            due = np.flatnonzero(frame.due)
            for side, ids, chosen, found in (
                ("vehicle", frame.vehicles, due.tolist(), result.vehicles),
                ("track", frame.tracks, kept, result.tracks),
            ):
                named = [(side, ids[n]) for n in chosen]
                found.append([numbers.setdefault(one, len(numbers)) for one in named])
            result.similarity.append(similarity(frame.vehicle_boxes[due], frame.boxes[kept]))
            result.scores.append(frame.scores[kept])
        return result

    @property
    def sides(self) -> tuple[list[list[int]], list[list[int]], list[list[list[float]]]]:
        """The input of `motrics`: it accepts arrays as well as lists, in half the time."""
        return self.vehicles, self.tracks, cast("list[list[list[float]]]", self.similarity)

    def above(self, score: float, by_track: dict[int, float]) -> Sequences:
        """Returns the sequences with only tracks of at least this score."""
        result = Sequences(self.vehicles, [], [], [])
        for ids, similarity, scores in zip(self.tracks, self.similarity, self.scores, strict=True):
            kept = [n for n, one in enumerate(ids) if by_track[one] >= score]
            result.tracks.append([ids[n] for n in kept])
            result.similarity.append(similarity[:, kept])
            result.scores.append(scores[kept])
        return result


@dataclass(frozen=True, slots=True)
class TrackScore:
    """Standard tracking measures, shares from 0 to 1; None where nothing was to be tracked.

    HOTA, DetA, AssA: Luiten et al. 2021, IDF1: Ristani et al. 2016, MOTA: Bernardin and
    Stiefelhagen 2008, AMOTA and sAMOTA: Weng et al. 2020, over 40 recalls. `passages` are the
    vehicles that were to be tracked.
    """

    hota: float | None
    assa: float | None
    deta: float | None
    idf1: float | None
    mota: float | None
    amota: float | None
    samota: float | None
    id_switches: int
    fragmentations: int
    passages: int

    @classmethod
    def of(cls, found: Sequences, least: float = _ANY) -> TrackScore:
        """Computes the measures; pairs of a similarity below `least` match for HOTA alone."""
        import motrics

        passages = len({one for ids in found.vehicles for one in ids})
        if not passages:
            return cls(None, None, None, None, None, None, None, 0, 0, 0)
        sides = found.sides
        hota = motrics.compute_hota_from_similarity(*sides)
        identity = motrics.compute_identity_from_similarity(*sides, threshold=least)
        clear = motrics.compute_clear_from_similarity(*sides, threshold=least)
        amota, samota = _over_recalls(found, least)
        return cls(
            hota.hota, hota.assa, hota.deta, identity.idf1, clear.mota, amota, samota,
            clear.num_switches, clear.frag, passages,
        )  # fmt: skip

    def as_text(self) -> Rows:
        """Returns the measures by readable names."""
        return (
            ("HOTA", percent(self.hota)),
            ("  DetA", percent(self.deta)),
            ("  AssA", percent(self.assa)),
            ("IDF1", percent(self.idf1)),
            ("MOTA", percent(self.mota)),
            ("AMOTA", percent(self.amota)),
            ("sAMOTA", percent(self.samota)),
            ("passages", str(self.passages)),
            ("  id switches", str(self.id_switches)),
            ("  fragmentations", str(self.fragmentations)),
        )

    @staticmethod
    def hota_of(found: Sequences) -> float | None:
        """Returns HOTA alone."""
        import motrics

        if not any(found.vehicles):
            return None
        return motrics.compute_hota_from_similarity(*found.sides).hota


def _over_recalls(found: Sequences, least: float) -> tuple[float, float]:
    """Returns AMOTA and sAMOTA: means over recalls; one that is not reached counts 0.

    As in Weng et al. 2020, a track's score is the mean of its boxes', and a recall is reached by
    leaving out the tracks below a score. sMOTA at recall r is MOTA scaled so that 1 can be reached:
    1 - (FP + FN + IDS - (1 - r) GT) / (r GT), between 0 and 1.
    """
    import motrics

    by_track = _mean_scores(found)
    hits = [
        by_track[ids[box]]
        for ids, similarity in zip(found.tracks, found.similarity, strict=True)
        for _, box in pairs_of(similarity, least)
    ]
    ranked, total = np.sort(hits)[::-1], sum(map(len, found.vehicles))
    mota, smota = 0.0, 0.0
    counted: dict[float, Any] = {}
    for level in range(1, RECALLS + 1):
        needed = -(-level * total // RECALLS)
        if needed > len(ranked):
            break
        score = float(ranked[needed - 1])
        if score not in counted:
            part = found.above(score, by_track)
            counted[score] = motrics.compute_clear_from_similarity(*part.sides, threshold=least)
        clear, recall = counted[score], level / RECALLS
        wrong = clear.num_false_positives + clear.num_misses + clear.num_switches
        mota += 1 - wrong / total
        smota += min(max(1 - (wrong - (1 - recall) * total) / (recall * total), 0.0), 1.0)
    return mota / RECALLS, smota / RECALLS


def _mean_scores(found: Sequences) -> dict[int, float]:
    sums: dict[int, list[float]] = {}
    for ids, scores in zip(found.tracks, found.scores, strict=True):
        for one, score in zip(ids, scores.tolist(), strict=True):
            entry = sums.setdefault(one, [0.0, 0.0])
            entry[0] += score
            entry[1] += 1
    return {one: total / count for one, (total, count) in sums.items()}


@dataclass(frozen=True, slots=True)
class MemoryScore:
    """Measures of coasting tracks: speed errors, and recovery of hidden vehicles.

    Speed errors are over boxes of vehicles that are due. A vehicle is hidden while it is due and no
    track's box of it is observed, for up to `HIDDEN_S`; it is `recovered` if it comes back under
    the id that it had. Boxes that have coasted `COASTED_S` are `near` within `MATCH_M` of the
    vehicle that their track was last observed on.
    """

    observed_rmse_mps: float | None
    coasted_rmse_mps: float | None
    hidden: int
    recovered: int
    coasted: int
    near: int

    @property
    def recovered_share(self) -> float | None:
        """Of the hidden vehicles."""
        return self.recovered / self.hidden if self.hidden else None

    @property
    def near_share(self) -> float | None:
        """Of the boxes that have coasted so long."""
        return self.near / self.coasted if self.coasted else None


def memory_score(frames: Iterable[TrackedFrame]) -> MemoryScore:
    """Goes through frames in the order of time."""
    errors: dict[bool, list[float]] = {False: [], True: []}
    followed: dict[Hashable, Hashable] = {}  # by track, the vehicle that it was last observed on
    known: dict[Hashable, tuple[int, float, Hashable]] = {}  # by vehicle: frame, time, track
    counted: dict[Hashable, float] = {}  # by track, since when it coasts
    hidden = recovered = coasted = near = 0
    for number, frame in enumerate(frames):
        pairs = pairs_of(centre_similarity(frame.vehicle_boxes, frame.boxes))
        for vehicle, box in pairs:
            name, track = frame.vehicles[vehicle], frame.tracks[box]
            is_coasted = bool(frame.coasted_s[box] > 0)
            if frame.due[vehicle]:
                speed_mps = abs(float(frame.speeds_mps[box]))
                errors[is_coasted].append(speed_mps - float(frame.vehicle_speeds_mps[vehicle]))
            if is_coasted:
                continue
            before = known.get(name)
            if frame.due[vehicle] and before is not None and before[0] < number - 1:
                is_short = frame.time_s - before[1] <= HIDDEN_S
                hidden += is_short
                recovered += is_short and before[2] == track
            known[name] = number, frame.time_s, track
        observed = np.flatnonzero(frame.coasted_s == 0).tolist()
        of_box = {box: frame.vehicles[vehicle] for vehicle, box in pairs}
        followed.update((frame.tracks[box], of_box.get(box)) for box in observed)
        for box in np.flatnonzero(frame.coasted_s >= COASTED_S - 1e-6).tolist():
            track, since_s = frame.tracks[box], frame.time_s - float(frame.coasted_s[box])
            if abs(counted.get(track, -np.inf) - since_s) > _SAME_S:
                counted[track] = since_s
                coasted += 1
                near += _is_near(frame, box, followed.get(track))
    rmse = {one: _rmse(values) for one, values in errors.items()}
    return MemoryScore(rmse[False], rmse[True], hidden, recovered, coasted, near)


def _is_near(frame: TrackedFrame, box: int, vehicle: Hashable) -> bool:
    if vehicle not in frame.vehicles:
        return False
    place = frame.vehicle_boxes[list(frame.vehicles).index(vehicle), :2]
    return bool(np.linalg.norm(place - frame.boxes[box, :2]) <= MATCH_M)


def _rmse(errors: list[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else None


def percent(share: float | None) -> str:
    """Returns a share as text."""
    return DASH if share is None else f"{100 * share:.1f} %"


def print_measures(rows: Rows, console: Console) -> None:
    """Prints names and figures as a table."""
    table = Table("tracks", "", box=SIMPLE_HEAD, pad_edge=False)
    table.columns[1].justify = "right"
    for row in rows:
        table.add_row(*row)
    console.print(table)
