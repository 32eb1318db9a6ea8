"""Colours of pictures, on dark, and of charts, on white; distinguishable by the colour-blind."""

from __future__ import annotations

BACKGROUND = "#0a0d13"
ASPHALT = "#151b26"
MARKING = "#3a4556"
TEXT = "#e6edf3"
FAINT = "#8b98a9"
BOX = "#ffd166"
TRUTH = "#ffffff"
AGENTS = ("#35c9f5", "#ff5c8a", "#9be564", "#b48cff", "#ff9f45", "#4fe0c0", "#f6e05e", "#7aa2ff")
SIGNAL = {"G": "#2ee66b", "g": "#2ee66b", "y": "#ffd166", "r": "#ff4d4d"}


def agent_colours(agents: list[str]) -> dict[str, str]:
    """Gives each agent a colour, in order; they repeat after eight."""
    return {agent: AGENTS[i % len(AGENTS)] for i, agent in enumerate(agents)}


# On white, for charts: Okabe and Ito 2008, the yellow left out.
SERIES = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c564b", "#4d4d4d",
)  # fmt: skip
GOOD = "#009e73"
BAD = "#d55e00"
PLAIN = "#0072b2"
QUIET = "#9aa4b1"
INK = "#1c2733"
INK_FAINT = "#5d6b7a"
GRID = "#e3e8ee"
LEVELS = ("#fdca26", "#fb9f3a", "#ed7953", "#d8576b", "#9c179e", "#46039f")
"""From the least to the most, ever darker: of the map plasma, Smith and van der Walt 2015."""
ROAD = "#e9edf2"
ROAD_EDGE = "#c5cdd7"
LAMPS = (("green", "#2a9d5c"), ("yellow", "#f0b429"), ("all red", "#c8553d"))
