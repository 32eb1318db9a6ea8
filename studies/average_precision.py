"""Average precision over 40 recall positions, AP40, as KITTI counts it (Simonelli et al. 2019).

Detections of all scenes are taken in the order of their scores. Each takes the free vehicle that it
overlaps most, if by more than the given IoU; a vehicle is taken once. The precision at a recall is
the best that is reached at this recall or a higher one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from perception.arrays import Bools, Floats, Ints
from perception.boxes import overlaps

View = Literal["bev", "3d"]
POSITIONS = 40
FALSE, HIT, NEITHER = 0, 1, 2
Outcomes = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Detections, ranked by score, beside a scene's vehicles, and all pairs that overlap.

    `order` (N,) is each ranked detection's place in what was given. `pairs` (K, 2) name ranked
    detection and vehicle, sorted; `iou` holds their overlap (K,) in both views.
    """

    order: Ints
    scores: Floats
    vehicles: int
    pairs: Ints
    iou: dict[View, Floats]

    @classmethod
    def of(cls, boxes: Floats, scores: Floats, truth: Floats) -> Scene:
        """Compares boxes (N, 7) with vehicles (M, 7); equal scores stay in their order."""
        order = np.argsort(-scores, kind="stable")
        bev, volume = overlaps(boxes[order], truth)
        pairs = np.argwhere(bev > 0.0)
        iou: dict[View, Floats] = {"bev": bev[*pairs.T], "3d": volume[*pairs.T]}
        return cls(order, scores[order], len(truth), pairs, iou)


@dataclass(frozen=True, slots=True)
class Score:
    """Average precision, recall and precision of all scenes together.

    A share is None where its denominator is 0.
    """

    vehicles: int
    ap40: float | None
    recall: float | None
    precision: float | None


def outcomes(scene: Scene, view: View, least_iou: float, due: Bools, fair: Bools) -> Outcomes:
    """Returns of each ranked detection (N,) whether it is a `HIT`, `FALSE` or `NEITHER`.

    Args:
        scene: the detections and the vehicles.
        view: which overlap counts.
        least_iou: a match overlaps by more than this.
        due: (M,) vehicles to be found. Others are neither missed, nor are their detections false; a
            detection prefers one that is due.
        fair: (N,) in the order given: detections that are false where they match no vehicle.
    """
    result = np.where(fair[scene.order], FALSE, NEITHER)
    iou = scene.iou[view]
    enough = np.flatnonzero(iou > least_iou)
    # Ranked detection by detection, vehicles that are due first, the most overlap first.
    found, vehicle = scene.pairs[enough].T
    taken = np.zeros(scene.vehicles, np.bool_)
    done = -1
    for k in np.lexsort((vehicle, -iou[enough], ~due[vehicle], found)):
        if found[k] != done and not taken[vehicle[k]]:
            done = found[k]
            taken[vehicle[k]] = True
            result[done] = HIT if due[vehicle[k]] else NEITHER
    return result


def average_precision(
    results: list[Outcomes], scores: list[Floats], vehicles: int, least_score: float = 0.0
) -> Score:
    """Returns the score of all scenes together, given their outcomes and scores by detection.

    `vehicles` is how many are due. Recall and precision are those of detections with `least_score`
    or more. Detections with equal scores count together: no threshold separates them, so that their
    order does not matter.
    """
    result = np.concatenate([np.zeros(0, np.int64), *results])
    ranks = np.concatenate([np.zeros(0), *scores])
    order = np.argsort(-ranks, kind="stable")
    order = order[result[order] != NEITHER]
    hit, ranks = result[order] == HIT, ranks[order]
    last = np.append(ranks[1:] != ranks[:-1], [True])[: len(ranks)]
    hits, all_so_far = np.cumsum(hit)[last], np.flatnonzero(last) + 1
    precision = hits / all_so_far
    used = hit[ranks >= least_score]
    total = int(used.sum())
    return Score(
        vehicles=vehicles,
        ap40=_ap40(hits, precision, vehicles) if vehicles else None,
        recall=total / vehicles if vehicles else None,
        precision=total / len(used) if len(used) else None,
    )


def _ap40(hits: Ints, precision: Floats, vehicles: int) -> float:
    best = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
    reached_at = np.searchsorted(hits * POSITIONS, vehicles * np.arange(1, POSITIONS + 1))
    return float(best[reached_at].mean())
