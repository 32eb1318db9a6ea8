"""What all Plotly figures of a page have in common."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import Any

from studies import palette

Json = dict[str, Any]
_MOST_FLAT = 70  # letters
BASE: Json = {
    "font": {"family": "system-ui, sans-serif", "size": 13, "color": palette.INK},
    "paper_bgcolor": "white",
    "plot_bgcolor": "white",
    "margin": {"l": 60, "r": 34, "t": 12, "b": 50},
    "modebar": {"orientation": "v", "bgcolor": "rgba(0,0,0,0)"},  # in the margin on the right
    "legend": {
        "orientation": "h",
        "x": 0,
        "y": 1.02,
        "yanchor": "bottom",
        "traceorder": "normal",
    },
    "hoverlabel": {"namelength": -1},
}


def axis(label: str, *, is_log: bool = False) -> Json:
    """Returns an axis; its labels always find room."""
    return {
        "title": {"text": safe(label), "standoff": 8},
        "type": "log" if is_log else "linear",
        "automargin": True,
        "gridcolor": palette.GRID,
        "linecolor": palette.GRID,
        "zeroline": False,
    }


def is_tight(names: tuple[str, ...]) -> bool:
    """Tells whether the names of categories would run into each other."""
    return len(names) * (max(map(len, names), default=0) + 2) > _MOST_FLAT


def safe(text: str) -> str:
    """Returns text that shows as it is: Plotly reads a kind of HTML."""
    return escape(text, quote=False)


def short(values: Iterable[float | int | None]) -> list[float | int | None]:
    """Returns numbers with as many digits as can be seen; what is not finite is a gap."""
    return [_short(value) for value in values]


def _short(value: float | int | None) -> float | int | None:
    if value is None or not abs(value) < float("inf"):
        return None
    return value if isinstance(value, int) else float(f"{value:.7g}")
