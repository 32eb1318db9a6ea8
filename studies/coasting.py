"""Effect of coasting tracks: E-CVPR with and without them, its bounds, and their precision.

Boxes of vehicles that a sensor saw in the frame, `observed`, are scored separately from those of
tracks that coast. Nobody can remember what no sensor has met: the vehicles of which LiDAR points
came, or that were within a LiDAR's range, in a frame or before, bound what tracks can give.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocol.messages import is_bystander
from recording.run import Run
from studies.ecvpr import (
    MARGIN_M,
    EvaluationArea,
    PerceptionBounds,
    matches,
    parked_bodies,
    score_frame,
    vehicles_of,
)
from studies.frame_rows import perceived_by_frame

Shares = dict[str, float | None]


@dataclass(frozen=True, slots=True)
class CoastingScore:
    """Shares from 0 to 1: `precision` of "observed", "coasted", "all", `ecvpr` of the outer two.

    `ecvpr` has the bounds of "all" as well: of the vehicles present, those that were
    "visible_so_far" and "in_range_so_far", as of `PerceptionBounds`.
    """

    precision: Shares
    ecvpr: Shares


def coasting_score(run: Run) -> CoastingScore:
    """Returns the score over all frames that have truth and were perceived.

    A box is true that lies on a vehicle, as E-CVPR matches them, wherever it is.

    Raises:
        ConfigError: the run folder lacks its setup.
    """
    area = EvaluationArea(run.setup.road_map)
    types = {kind.name: kind for kind in run.setup.vehicle_types}
    parked, bounds = parked_bodies(run.setup), PerceptionBounds(run)
    met: dict[str, set[str]] = {"visible_so_far": set(), "in_range_so_far": set()}
    boxes, false = {True: 0, False: 0}, {True: 0, False: 0}
    rates: dict[str, list[float]] = {name: [] for name in ("observed", "all", *met)}
    for frame, found, vehicles in perceived_by_frame(run):
        bodies = vehicles + parked
        for one in vehicles_of(found):
            boxes[one.coasted_s > 0] += 1
        for one in matches(found, bodies, types)[1]:
            false[one.coasted_s > 0] += 1
        seen = [one for one in found if one.coasted_s == 0]
        for name, part in (("observed", seen), ("all", found)):
            rate = score_frame(frame, part, bodies, types, area, MARGIN_M).e_cvpr
            rates[name] += [] if rate is None else [rate]
        traffic = [one for one in vehicles if not is_bystander(one.vehicle)]
        met["visible_so_far"] |= bounds.visible(frame, traffic)
        met["in_range_so_far"] |= bounds.in_range(traffic)
        present = {v.vehicle for v in traffic if area.contains(v.lane, v.lane_position_m)}
        for name, known in met.items():
            rates[name] += [len(present & known) / len(present)] if present else []
    precision = {
        "observed": _share(boxes[False] - false[False], boxes[False]),
        "coasted": _share(boxes[True] - false[True], boxes[True]),
        "all": _share(sum(boxes.values()) - sum(false.values()), sum(boxes.values())),
    }
    return CoastingScore(precision, {k: _share(sum(v), len(v)) for k, v in rates.items()})


def _share(part: float, whole: int) -> float | None:
    return part / whole if whole else None
