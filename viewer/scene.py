"""A frame as a picture: what of a moment is shown, and in whose colour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from protocol.messages import Metrics, Setup
from studies.ecvpr import FrameScore
from viewer import layers
from viewer.clouds import Cloud, clouds
from viewer.colours import Colours, Rgb
from viewer.figures import Judge, phase_names, pressures
from viewer.layers import Boxes, Lines, Texts
from viewer.moments import Moment
from viewer.rates import Rates
from viewer.road import Heads, count_places, heads


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """All that is drawn of one frame; what nobody said is None."""

    frame: int
    sim_time_ns: int
    colours: Mapping[str, Rgb]
    clouds: list[Cloud]
    boxes: Boxes | None
    fronts: Texts | None
    truth: Boxes | None
    lamps: list[Rgb] | None
    counts: Texts | None
    cells: Lines
    mbps: dict[str, float]
    pressures: dict[str, float]
    score: FrameScore | None


class Scene:
    """Makes pictures of one run's moments."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.heads: Heads = heads(setup.road_map)
        self._places = count_places(setup.road_map)
        self.phases = phase_names(setup.road_map)
        self._types = {kind.name: kind for kind in setup.vehicle_types}
        self._judge = Judge(setup.road_map, self._types)
        self._colours = Colours()
        self._rates = Rates(round(float(setup.scenario["frame_period_s"]) * 1e9))

    def measured(self, metrics: Metrics) -> None:
        """Takes what a process says that it sent."""
        self._rates.take(metrics)

    def picture(self, moment: Moment) -> Picture | None:
        """Returns the picture of a moment; None if nobody said when it was."""
        sim_time_ns = moment.sim_time_ns
        if sim_time_ns is None:
            return None
        road_map, found = self.setup.road_map, moment.detections
        shown = clouds(moment.scans)
        said = found.agents if found else []
        colours = self._colours.of([cloud.agent for cloud in shown] + said)
        state = moment.state
        return Picture(
            frame=moment.frame,
            sim_time_ns=sim_time_ns,
            colours=colours,
            clouds=shown,
            boxes=layers.detected(found, colours) if found else None,
            fronts=layers.fronts(found) if found else None,
            truth=layers.true_boxes(moment.truth, self._types) if moment.truth else None,
            lamps=layers.lamps(state, road_map, self.heads.lanes) if state else None,
            counts=layers.lane_counts(moment.counts, self._places) if moment.counts else None,
            cells=layers.plan_cells(moment.plan, road_map, colours),
            mbps=self._rates.mbps(sim_time_ns),
            pressures=pressures(moment.request, self.phases),
            score=self._judge.score(moment),
        )
