"""Draws pictures and figures with Rerun, and lays them out on the screen."""

from __future__ import annotations

import math

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from studies import palette
from viewer.layers import Boxes, Lines, Rgb, Texts, rgb
from viewer.road import camera, surface
from viewer.scene import Picture, Scene
from viewer.stages import GROUPS, FrameLatency

FRAME, TIME = "frame", "sim time"
TRUTH, COUNTS, FRONTS = "/scene/truth", "/scene/counts", "/scene/boxes/front"
_BARS, _HEADS = "/scene/signal/stop_bars", "/scene/signal/heads"
_POINT_UI, _LINE_M, _BAR_M, _HEAD_M = -1.0, 0.05, 0.35, 0.6
_EDGE_M, _CELL_M, _TRAIL_M = 0.07, 0.15, 0.06
_FAR_HEAD_UI = -3.5  # as large on the screen from any distance


class Log:
    """Draws into one recording."""

    def __init__(self, recording: rr.RecordingStream, scene: Scene) -> None:
        """Draws the static parts: road, signal heads, camera."""
        self._to = recording
        self._agents: set[str] = set()
        self._plotted: set[str] = set()
        self._is_overview, self._signals = scene.is_overview, scene.signals
        self._road(scene)
        self._style_plots(scene)

    def picture(self, picture: Picture) -> None:
        """See `viewer.live.Shows.picture`."""
        self._set_time(picture.frame, picture.sim_time_ns)
        self._clouds(picture)
        if picture.boxes is not None:
            self._boxes("/scene/boxes", picture.boxes)
        if picture.fronts is not None:
            self._texts(FRONTS, picture.fronts)
        if picture.trails is not None:
            self._lines("/scene/trails", picture.trails, _TRAIL_M)
        if picture.truth is not None:
            self._boxes(TRUTH, picture.truth)
        if picture.lamps is not None:
            self._lamps(picture.lamps)
        if picture.counts is not None:
            self._texts(COUNTS, picture.counts)
        if picture.totals is not None and self._is_overview:
            self._texts("/scene/junctions", picture.totals)
        self._lines("/scene/cells", picture.cells, _CELL_M)
        self._figures(picture)

    def latency(self, latency: FrameLatency) -> None:
        """See `viewer.live.Shows.latency`."""
        self._set_time(latency.frame, latency.sim_time_ns)
        self._scalars("/latency", [*latency.groups_ms.values(), latency.end_to_end_ms])

    def _set_time(self, frame: int, sim_time_ns: int) -> None:
        self._to.set_time(FRAME, sequence=frame)
        self._to.set_time(TIME, duration=sim_time_ns / 1e9)

    def _road(self, scene: Scene) -> None:
        road = surface(scene.road_map)
        self._to.log("/scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        mesh = rr.Mesh3D(
            vertex_positions=road.vertices,
            triangle_indices=road.triangles,
            albedo_factor=rgb(palette.ASPHALT),
        )
        self._to.log("/scene/road/surface", mesh, static=True)
        lines = rr.LineStrips3D(road.markings, radii=_LINE_M, colors=rgb(palette.MARKING))
        self._to.log("/scene/road/lanes", lines, static=True)
        bars = rr.LineStrips3D(scene.heads.bars, radii=_BAR_M)
        self._to.log(_BARS, bars, static=True)
        radius = _FAR_HEAD_UI if scene.is_overview else _HEAD_M
        heads = rr.Points3D(scene.heads.places, radii=radius)
        self._to.log(_HEADS, heads, static=True)

    def _clouds(self, picture: Picture) -> None:
        there = {cloud.agent for cloud in picture.clouds}
        for agent in self._agents - there:
            self._to.log(f"/scene/cloud/{_part(agent)}", rr.Clear(recursive=False))
        self._agents = there
        for cloud in picture.clouds:
            points = rr.Points3D(cloud.points, colors=picture.colours[cloud.agent], radii=_POINT_UI)
            self._to.log(f"/scene/cloud/{_part(cloud.agent)}", points)
        sensors = rr.Points3D(
            np.array([cloud.sensor_m for cloud in picture.clouds]).reshape(-1, 3),
            colors=[picture.colours[cloud.agent] for cloud in picture.clouds],
            labels=[cloud.agent for cloud in picture.clouds],
            radii=_HEAD_M,
            show_labels=not self._is_overview,
        )
        self._to.log("/scene/agents", sensors)

    def _boxes(self, path: str, boxes: Boxes) -> None:
        half_yaw = boxes.values[:, 6] / 2
        zeros = np.zeros_like(half_yaw)
        drawn = rr.Boxes3D(
            centers=boxes.values[:, :3],
            half_sizes=boxes.values[:, 3:6] / 2,
            quaternions=np.stack([zeros, zeros, np.sin(half_yaw), np.cos(half_yaw)], axis=1),
            colors=boxes.colours,
            labels=boxes.labels,
            show_labels=False,
            radii=_EDGE_M,
            fill_mode="majorwireframe",
        )
        self._to.log(path, drawn)

    def _lamps(self, colours: list[Rgb]) -> None:
        self._to.log(_BARS, rr.LineStrips3D.from_fields(colors=colours))
        self._to.log(_HEADS, rr.Points3D.from_fields(colors=colours))

    def _texts(self, path: str, texts: Texts) -> None:
        drawn = rr.Points3D(
            texts.places, radii=0.05, labels=texts.texts, colors=texts.colours, show_labels=True
        )
        self._to.log(path, drawn)

    def _lines(self, path: str, lines: Lines, radius_m: float) -> None:
        drawn = rr.LineStrips3D(
            lines.lines,
            colors=lines.colours,
            labels=lines.names,
            radii=radius_m,
            show_labels=False,
        )
        self._to.log(path, drawn)

    def _style_plots(self, scene: Scene) -> None:
        stages = [*_cycle(len(GROUPS) - 1), rgb(palette.FAINT), rgb(palette.TEXT)]
        widths = [*[1.5] * len(GROUPS), 2.5]
        self._style("/latency", [*GROUPS, "end to end"], stages, widths)
        phases = scene.phases
        self._style("/pressure", phases, _cycle(len(phases)), [2.0] * len(phases))
        if scene.is_overview:
            self._style("/queue", scene.signals, _cycle(len(scene.signals)), [2.0])
        self._style("/e_cvpr", ["E-CVPR %"], [rgb(palette.AGENTS[2])], [2.0])

    def _figures(self, picture: Picture) -> None:
        for agent, mbps in picture.mbps.items():
            path = f"/uplink/{_part(agent)}"
            if path not in self._plotted and agent in picture.colours:
                self._plotted.add(path)
                self._style(path, [agent], [picture.colours[agent]], [2.0])
            self._scalars(path, [mbps])
        if picture.pressures:
            self._scalars("/pressure", [*picture.pressures.values()])
        if self._is_overview and picture.queues:
            values = [float(picture.queues.get(tls, math.nan)) for tls in self._signals]
            self._scalars("/queue", values)
        if picture.score is not None and picture.score.e_cvpr is not None:
            self._scalars("/e_cvpr", [100 * picture.score.e_cvpr])

    def _style(self, path: str, names: list[str], colours: list[Rgb], widths: list[float]) -> None:
        """Sets once the style of a plot's lines, in the order of their values."""
        style = rr.SeriesLines(colors=colours, names=names, widths=widths)
        self._to.log(path, style, static=True)

    def _scalars(self, path: str, values: list[float]) -> None:
        self._to.log(path, rr.Scalars(values))


def _part(name: str) -> str:
    return str(rr.escape_entity_path_part(name))


def _cycle(count: int) -> list[Rgb]:
    return [rgb(palette.AGENTS[n % len(palette.AGENTS)]) for n in range(count)]


PLOTTED_S = 30.0
_COLUMNS = (5, 2)
_ROWS = (4, 7, 3, 3)


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Returns the layout for a run; truth is there, but hidden until it is asked for.

    So are, of several junctions, the texts of single lanes: they would hide one another.
    """
    return rrb.Blueprint(
        rrb.Horizontal(_junctions(scene), _plots(scene), column_shares=_COLUMNS),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def _junctions(scene: Scene) -> rrb.Spatial3DView:
    look = camera(scene.road_map)
    hidden = [TRUTH, COUNTS, FRONTS] if scene.is_overview else [TRUTH]
    return rrb.Spatial3DView(
        origin="/scene",
        name=f"{scene.setup.scenario.get('name', 'junction')} as the edge sees it",
        background=rgb(palette.BACKGROUND),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=look.position, look_target=look.target),
        overrides={path: rrb.EntityBehavior(visible=False) for path in hidden},
    )


def _plots(scene: Scene) -> rrb.Vertical:
    share = rrb.ScalarAxis(range=(0.0, 100.0))
    control = ("/pressure", "pressure of each phase, vehicles")
    if scene.is_overview:
        control = ("/queue", "queued before the stop bars of each junction, vehicles")
    return rrb.Vertical(
        _plot("/uplink", "upload of each agent, Mbit/s"),
        _plot("/latency", "from sensing to signal by stage, ms"),
        _plot(*control),
        _plot("/e_cvpr", "E-CVPR: vehicles detected or coasting, %", axis=share, has_legend=False),
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
