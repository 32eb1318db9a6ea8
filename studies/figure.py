"""The picture of a frame: from above, from a crane, and its figures."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from studies import palette
from studies.perspective import draw_perspective
from studies.plan_view import draw_plan
from studies.snapshot import Snapshot

_WIDTH, _HEIGHT = 16.0, 8.1  # inches
_DPI = 120
_NAMED = 7
_PANELS = ((0.01, 0.1, 0.487, 0.82), (0.503, 0.1, 0.487, 0.82))


def save_picture(snapshot: Snapshot, path: Path) -> None:
    """Draws a snapshot into a PNG of 1920 x 972 pixels."""
    figure = Figure(figsize=(_WIDTH, _HEIGHT), dpi=_DPI, facecolor=palette.BACKGROUND)
    canvas = FigureCanvasAgg(figure)
    colours = palette.agent_colours([cloud.agent for cloud in snapshot.clouds])
    plan, crane = (_panel(figure, place) for place in _PANELS)
    aspect = _PANELS[0][2] * _WIDTH / (_PANELS[0][3] * _HEIGHT)
    draw_plan(plan, snapshot, colours, aspect)
    crane.set(xlim=(-0.6, 0.6), ylim=(-0.6 / aspect - 0.03, 0.6 / aspect - 0.03))
    draw_perspective(crane, snapshot, colours)
    figure.text(0.012, 0.941, _title(snapshot), color=palette.TEXT, fontsize=19, fontweight="bold")
    figure.text(0.988, 0.945, _figures(snapshot), color=palette.FAINT, fontsize=12.5, ha="right")
    for handles, bottom in ((_agents(snapshot, colours), 0.04), (_symbols(snapshot), 0.004)):
        figure.legend(
            handles=handles,
            loc="lower center",
            ncols=len(handles),
            frameon=False,
            labelcolor=palette.TEXT,
            fontsize=10.5,
            bbox_to_anchor=(0.5, bottom),
            columnspacing=1.6,
            handletextpad=0.5,
        )
    canvas.print_png(str(path))


def _panel(figure: Figure, place: tuple[float, float, float, float]) -> Axes:
    axes = figure.add_axes(place, facecolor=palette.BACKGROUND)
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=palette.MARKING, linewidth=0.8)
    return axes


def _title(snapshot: Snapshot) -> str:
    time_ns = snapshot.row.sim_time_ns
    when = f" · {time_ns / 1e9:.1f} s" if time_ns is not None else ""
    return f"{snapshot.name} · frame {snapshot.row.frame}{when}"


def _figures(snapshot: Snapshot) -> str:
    score, row = snapshot.score, snapshot.row
    points = sum(len(cloud.points) for cloud in snapshot.clouds)
    kilobytes = sum(cloud.payload_bytes for cloud in snapshot.clouds) / 1e3
    facts = [f"{points:,} points in {kilobytes:.0f} kB".replace(",", " ")]
    if score.present:
        facts.append(f"{score.true} of {score.present} vehicles detected, {score.false} false")
    if row.end_to_end_ns is not None:
        facts.append(f"{row.end_to_end_ns / 1e6:.0f} ms from sensing to signal")
    return "   |   ".join(facts)


def _agents(snapshot: Snapshot, colours: dict[str, str]) -> list[Line2D]:
    named = snapshot.clouds[:_NAMED]
    handles = [
        Line2D([], [], color=colours[c.agent], marker="o", ls="", label=c.agent) for c in named
    ]
    if len(snapshot.clouds) > len(named):
        label = f"and {len(snapshot.clouds) - len(named)} more"
        handles.append(Line2D([], [], ls="", label=label))
    return handles


def _symbols(snapshot: Snapshot) -> list[Line2D]:
    handles = [Line2D([], [], color=palette.BOX, lw=1.8, label="detected")]
    if len(snapshot.truth.values):
        handles.append(Line2D([], [], color=palette.TRUTH, lw=0.9, ls="--", label="truth"))
    sides = (("counted upstream", palette.TEXT), ("downstream", palette.FAINT))
    handles += [
        Line2D([], [], color=colour, marker="$7$", markersize=8, ls="", label=label)
        for label, colour in sides
    ]
    return handles
