"""What is where on the screen: the junction, and beside it the plots; nothing has to be clicked."""

from __future__ import annotations

import rerun.blueprint as rrb

from studies import palette
from viewer.colours import rgb
from viewer.log import TIME, TRUTH
from viewer.road import camera
from viewer.scene import Scene

PLOTTED_S = 30.0
_COLUMNS = (5, 2)
_ROWS = (4, 7, 3, 3)


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Returns the layout for a run; truth is there, but hidden until it is asked for."""
    return rrb.Blueprint(
        rrb.Horizontal(_junction(scene), _plots(), column_shares=_COLUMNS),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def _junction(scene: Scene) -> rrb.Spatial3DView:
    look = camera(scene.setup.road_map)
    return rrb.Spatial3DView(
        origin="/scene",
        name=f"{scene.setup.scenario.get('name', 'junction')} as the edge sees it",
        background=rgb(palette.BACKGROUND),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=look.position, look_target=look.target),
        overrides={TRUTH: rrb.EntityBehavior(visible=False)},
    )


def _plots() -> rrb.Vertical:
    share = rrb.ScalarAxis(range=(0.0, 100.0))
    return rrb.Vertical(
        _plot("/uplink", "upload of each agent, Mbit/s"),
        _plot("/latency", "from sensing to signal by stage, ms"),
        _plot("/pressure", "pressure of each phase, vehicles"),
        _plot("/e_cvpr", "E-CVPR: vehicles truly detected, %", axis=share, has_legend=False),
        row_shares=_ROWS,
    )


def _plot(
    origin: str, title: str, *, axis: rrb.ScalarAxis | None = None, has_legend: bool = True
) -> rrb.TimeSeriesView:
    newest = rrb.VisibleTimeRange(
        TIME,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-PLOTTED_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    legend = rrb.PlotLegend(visible=has_legend, corner=rrb.Corner2D.LeftTop)
    return rrb.TimeSeriesView(
        origin=origin, name=title, axis_y=axis, plot_legend=legend, time_ranges=newest
    )
