"""Figures of one frame that plots and tables show."""

from __future__ import annotations

from collections.abc import Mapping

from protocol.messages import SignalRequest, VehicleType
from protocol.roadmap import RoadMap
from recording.rows import detection_rows, truth_rows
from studies.ecvpr import EvaluationArea, FrameScore, score_frame
from viewer.moments import Moment
from viewer.road import approaches


class Judge:
    """Compares what was detected with the truth."""

    def __init__(self, road_map: RoadMap, types: Mapping[str, VehicleType]) -> None:
        self._reach = EvaluationArea(road_map)
        self._types = dict(types)

    def score(self, moment: Moment) -> FrameScore | None:
        """Returns a frame's score; None without truth or detections."""
        if moment.detections is None or moment.truth is None:
            return None
        found, vehicles = detection_rows(moment.detections), truth_rows(moment.truth)
        return score_frame(moment.frame, [*found], [*vehicles], self._types, self._reach)


def phase_names(road_map: RoadMap) -> list[str]:
    """Returns a name for each phase of the signal: who gets green, such as "east_in, west_in"."""
    signal = road_map.signal
    names = []
    for green in signal.greens:
        lanes = [link.from_lane for link in signal.links if green[link.index] in "Gg"]
        names.append(", ".join(approaches(road_map, lanes)) or green)
    doubled = {name for name in names if names.count(name) > 1}
    return [f"{name} ({n + 1})" if name in doubled else name for n, name in enumerate(names)]


def pressures(request: SignalRequest | None, names: list[str]) -> dict[str, float]:
    """Returns the pressure of each phase; nothing where the policy knows none."""
    if request is None or len(request.pressures) != len(names):
        return {}
    return dict(zip(names, request.pressures, strict=True))
