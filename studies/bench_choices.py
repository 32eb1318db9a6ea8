"""What benches measure if nothing else is asked for."""

from __future__ import annotations

FRAME_PERIOD_S = 0.1
LEARNING_FRAMES = 10  # of standing sensors' backgrounds and of rates: not scored
SHARING = "sharing"  # without an edge
POLICY_CHOICES = (
    "full", "roi", "foreground", "voronoi", "power", "reap", "reap+roi", "reap+foreground",
    "objects", SHARING,
)  # fmt: skip
LINK_CHOICES = ("5mbit", "lte", "5g-urban")
LOOKING_WAYS = ("record", "save", "web")
