"""Colours of pictures: on dark, told apart by the colour-blind as far as may be."""

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
