"""The picture of a frame: lanes, counts, clouds and boxes from above, and figures beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from perception.arrays import Floats
from protocol.errors import ConfigError
from protocol.roadmap import Lane, RoadMap
from recording.run import Run
from studies import palette
from studies.outlines import borders, footprints, resampled, stands_out
from studies.snapshot import Boxes, Snapshot, load_snapshot

_SHOWN_M = 58.0
_VERGE_M = 13.0
_LABEL_INSET_M = 4.0


def draw_frame(run_dir: Path, frame: int | None, png_path: Path | None) -> Path:
    """Draws the merged cloud of a frame by agent, with boxes, truth, lanes and counts.

    Returns the path of the picture.

    Args:
        run_dir: the run's folder.
        frame: a frame whose uploads were recorded; None for the fullest of them.
        png_path: the picture to write; None for `frame-N.png` in the run's folder.

    Raises:
        ConfigError: no such run or frame, a picture that is no .png, or one that cannot be written.
    """
    if png_path is not None and png_path.suffix.lower() != ".png":
        raise ConfigError(f"--png {png_path}: needs a name that ends in .png")
    with Run(run_dir) as run:
        snapshot = load_snapshot(run, frame)
    path = png_path or run_dir / f"frame-{snapshot.row.frame}.png"
    try:
        save_picture(snapshot, path)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from None
    return path


def draw_plan(axes: Axes, snapshot: Snapshot, colours: dict[str, str], aspect: float) -> None:
    """Draws the junction and its arms; `aspect` is the picture's width over its height."""
    low, high = _window(snapshot.road_map, aspect)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    _draw_road(axes, snapshot.road_map)
    for cloud in snapshot.clouds:
        inside = ((cloud.points[:, :2] > low) & (cloud.points[:, :2] < high)).all(axis=1)
        _draw_points(axes, cloud.points[inside], colours[cloud.agent])
    _draw_truth(axes, snapshot.truth)
    _draw_boxes(axes, snapshot.detections, colours)
    _draw_signal(axes, snapshot)
    _draw_sensors(axes, snapshot, colours)
    _draw_counts(axes, snapshot, low, high)


def _window(road_map: RoadMap, aspect: float) -> tuple[Floats, Floats]:
    """Returns the corners of the smallest window with all roads near the centre, and a margin."""
    points = np.concatenate([resampled(lane.points[:, :2]) for lane in road_map.lanes])
    centre = np.array(road_map.centre[:2])
    near = points[np.abs(points - centre).max(axis=1) <= _SHOWN_M]
    near = near if len(near) else centre[None]
    low, high = near.min(axis=0) - _VERGE_M, near.max(axis=0) + _VERGE_M
    # an arm is cut at `_SHOWN_M`, so that no verge is needed there
    low, high = np.maximum(low, centre - _SHOWN_M), np.minimum(high, centre + _SHOWN_M)
    width, height = high - low
    half = np.array([max(width, height * aspect), max(height, width / aspect)]) / 2
    middle = (low + high) / 2
    return middle - half, middle + half


def _draw_road(axes: Axes, road_map: RoadMap) -> None:
    sides = [borders(lane) for lane in road_map.lanes]
    surfaces = [np.concatenate([left, right[::-1]])[:, :2] for left, right in sides]
    outlines = [one.outline for one in road_map.intersections if len(one.outline) > 2]
    surfaces += [np.array(outline) for outline in outlines]
    axes.add_collection(PolyCollection(surfaces, facecolors=palette.ASPHALT, zorder=1))
    lines = [
        side[:, :2]
        for lane, both in zip(road_map.lanes, sides, strict=True)
        if not lane.internal
        for side in both
    ]
    axes.add_collection(LineCollection(lines, colors=palette.MARKING, linewidths=0.6, zorder=2))


def _draw_points(axes: Axes, points: Floats, colour: str) -> None:
    high = stands_out(points)
    for part, size, alpha in ((~high, 0.7, 0.28), (high, 1.6, 0.8)):
        x, y = points[part, :2].T
        axes.scatter(x, y, s=size, color=colour, alpha=alpha, linewidths=0, zorder=3)


def _draw_truth(axes: Axes, truth: Boxes) -> None:
    outlines = PolyCollection(
        list(footprints(truth.values)),
        facecolors="none",
        edgecolors=palette.TRUTH,
        linewidths=0.8,
        linestyles=[(0, (2, 1.5))],
        zorder=6,
    )
    axes.add_collection(outlines)


def _draw_boxes(axes: Axes, boxes: Boxes, colours: dict[str, str]) -> None:
    shapes = list(footprints(boxes.values))
    edges = [colours.get(source, palette.BOX) for source in boxes.sources]
    filled = PolyCollection(shapes, facecolors=edges, edgecolors="none", alpha=0.16, zorder=5)
    drawn = PolyCollection(shapes, facecolors="none", edgecolors=edges, linewidths=1.5, zorder=7)
    axes.add_collection(filled)
    axes.add_collection(drawn)


def _draw_signal(axes: Axes, snapshot: Snapshot) -> None:
    """Draws each stop bar in the colour that its lane is shown; green if any of its links is."""
    road = snapshot.road_map
    for name in road.incoming:
        if name in road.by_id:
            left, right = (side[-1, :2] for side in borders(road.by_id[name]))
            ends = np.array([left + 0.12 * (right - left), right + 0.12 * (left - right)])
            colour = palette.SIGNAL.get(_letter(snapshot, name), palette.FAINT)
            axes.plot(*ends.T, color=colour, lw=4, solid_capstyle="butt", zorder=8)


def _letter(snapshot: Snapshot, lane: str) -> str:
    letters = [
        shown[link.index]
        for one in snapshot.road_map.intersections
        for shown in [snapshot.shown.get(one.tls, "")]
        for link in one.signal.links
        if link.from_lane == lane and link.index < len(shown)
    ]
    return min(letters, key="Ggyr".find, default="")


def _draw_sensors(axes: Axes, snapshot: Snapshot, colours: dict[str, str]) -> None:
    for cloud in snapshot.clouds:
        x, y = cloud.sensor_m[:2]
        for size, alpha in ((190, 0.25), (40, 1.0)):
            axes.scatter(
                x, y, s=size, color=colours[cloud.agent], alpha=alpha, linewidths=0, zorder=9
            )


def _draw_counts(axes: Axes, snapshot: Snapshot, low: Floats, high: Floats) -> None:
    """Writes each lane's count where the lane enters or leaves the picture."""
    for (name, side), count in snapshot.counts.items():
        if name in snapshot.road_map.by_id:
            upstream = side == "upstream"
            place = _label_place(snapshot.road_map.by_id[name], low, high, upstream)
            axes.annotate(
                str(count),
                (float(place[0]), float(place[1])),
                color=palette.TEXT if upstream else palette.FAINT,
                fontsize=9,
                fontweight="bold" if upstream else "normal",
                ha="center",
                va="center",
                zorder=11,
                annotation_clip=True,
                bbox={
                    "boxstyle": "round,pad=0.22",
                    "facecolor": palette.BACKGROUND,
                    "edgecolor": palette.MARKING,
                    "linewidth": 0.7,
                    "alpha": 0.85,
                },
            )


def _label_place(lane: Lane, low: Floats, high: Floats, upstream: bool) -> Floats:
    points = resampled(lane.points[:, :2] if upstream else lane.points[::-1, :2])
    inside = ((points > low + _LABEL_INSET_M) & (points < high - _LABEL_INSET_M)).all(axis=1)
    place: Floats = points[int(np.argmax(inside))] if inside.any() else points[-1]
    return place


_WIDTH_IN, _HEIGHT_IN, _DPI = 16.0, 9.0, 120
_PLAN = (0.012, 0.021, 0.726, 0.958)  # left, bottom, width, height as shares of the picture
_SIDE_IN = (0.755 * _WIDTH_IN, 0.986 * _WIDTH_IN)  # left and right end of the figures beside it
_LINE_IN = 0.27
_NAMED = 9  # agents
_NAME_LETTERS = 23


def save_picture(snapshot: Snapshot, path: Path) -> None:
    """Draws a snapshot into a PNG of 1920 x 1080 pixels."""
    figure = Figure(figsize=(_WIDTH_IN, _HEIGHT_IN), dpi=_DPI, facecolor=palette.BACKGROUND)
    canvas = FigureCanvasAgg(figure)
    colours = palette.agent_colours([cloud.agent for cloud in snapshot.clouds])
    plan = figure.add_axes(_PLAN, facecolor=palette.BACKGROUND)
    plan.set(xticks=[], yticks=[])
    for spine in plan.spines.values():
        spine.set(color=palette.MARKING, linewidth=0.8)
    draw_plan(plan, snapshot, colours, _PLAN[2] * _WIDTH_IN / (_PLAN[3] * _HEIGHT_IN))
    _SideBar(figure).fill(snapshot, colours)
    canvas.print_png(str(path))


class _SideBar:
    """The column beside the plan, filled from top to bottom; its axes are in inches."""

    def __init__(self, figure: Figure) -> None:
        self._axes: Axes = figure.add_axes((0, 0, 1, 1), facecolor="none")
        self._axes.set(xlim=(0, _WIDTH_IN), ylim=(0, _HEIGHT_IN))
        self._axes.axis("off")
        self._y_in = _HEIGHT_IN - 0.42

    def fill(self, snapshot: Snapshot, colours: dict[str, str]) -> None:
        """Writes title, figures, agents and the legend."""
        time_ns, score = snapshot.row.sim_time_ns, snapshot.score
        when = f" at {time_ns / 1e9:.1f} s" if time_ns is not None else ""
        self._text(_SIDE_IN[0], snapshot.name, palette.TEXT, size=19, weight="bold")
        self._line(0.34)
        self._text(_SIDE_IN[0], f"frame {snapshot.row.frame}{when}", palette.FAINT, size=12.5)
        self._line(0.5)
        if score.present:
            self._row("vehicles near the signal", str(score.present))
            self._row("detected or coasting", str(score.true))
            self._row("false detections", str(score.false))
        if snapshot.row.end_to_end_ns is not None:
            self._row("sensing to signal", f"{snapshot.row.end_to_end_ns / 1e6:.0f} ms")
        self._line(0.24)
        self._agents(snapshot, colours)
        self._line(0.24)
        self._symbols(has_truth=len(snapshot.truth.values) > 0)

    def _agents(self, snapshot: Snapshot, colours: dict[str, str]) -> None:
        self._row("uploaded by", "points", "kB", colour=palette.FAINT)
        for cloud in snapshot.clouds[:_NAMED]:
            sizes = _grouped(len(cloud.points)), f"{cloud.payload_bytes / 1e3:.1f}"
            self._axes.plot(_SIDE_IN[0] + 0.05, self._y_in, "o", color=colours[cloud.agent], ms=7)
            self._row(_shortened(cloud.agent), *sizes, indent_in=0.2)
        more = len(snapshot.clouds) - _NAMED
        if more > 0:
            self._row(f"and {more} more", indent_in=0.2)
        points = sum(len(cloud.points) for cloud in snapshot.clouds)
        payload_bytes = sum(cloud.payload_bytes for cloud in snapshot.clouds)
        self._row("all together", _grouped(points), f"{payload_bytes / 1e3:.1f}", indent_in=0.2)

    def _symbols(self, *, has_truth: bool) -> None:
        handles = [Line2D([], [], color=palette.BOX, lw=1.8, label="detected or coasting")]
        if has_truth:
            handles.append(Line2D([], [], color=palette.TRUTH, lw=0.9, ls="--", label="truth"))
        counted = (("upstream", palette.TEXT), ("downstream", palette.FAINT))
        handles += [
            Line2D([], [], color=colour, marker="$7$", ms=8, ls="", label=f"counted {side}")
            for side, colour in counted
        ]
        self._axes.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(_SIDE_IN[0], self._y_in + 0.15),
            bbox_transform=self._axes.transData,
            frameon=False,
            labelcolor=palette.TEXT,
            fontsize=11.5,
            borderpad=0,
            borderaxespad=0,
            labelspacing=0.65,
        )

    def _row(
        self, name: str, *values: str, colour: str = palette.TEXT, indent_in: float = 0.0
    ) -> None:
        """Writes a name and, ending at the right, its values."""
        self._text(_SIDE_IN[0] + indent_in, name, colour)
        for number, value in enumerate(reversed(values)):
            self._text(_SIDE_IN[1] - 0.72 * number, value, colour, align="right")
        self._line(_LINE_IN)

    def _line(self, height_in: float) -> None:
        self._y_in -= height_in

    def _text(
        self, x_in: float, text: str, colour: str, *, size: float = 11.5, weight: str = "normal",
        align: str = "left",
    ) -> None:  # fmt: skip
        self._axes.text(
            x_in, self._y_in, text, color=colour, fontsize=size, fontweight=weight, ha=align,
            va="center", parse_math=False,
        )  # fmt: skip


def _grouped(number: int) -> str:
    return f"{number:,}".replace(",", " ")


def _shortened(name: str) -> str:
    return name if len(name) <= _NAME_LETTERS else f"{name[: _NAME_LETTERS - 1]}…"
