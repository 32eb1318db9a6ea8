"""A run: its summary, what the recorder takes, what a command printed."""

from __future__ import annotations

import json
from statistics import mean
from typing import Any

from layouts.tables import Rows, Table, fixed


def recorder(rows: Rows) -> Table:
    """Returns what the recorder of a city takes."""
    row = rows[0]
    tables = row["gb_by_table"]
    shown = [f"`{name}` {fixed(tables[name], 2)}" for name in _LARGE]
    return [
        ["junctions, regions, agents, vehicles", "frames/s", "core-ms a frame", "GB/h", "of these"],
        [
            ", ".join(str(row[key]) for key in ("junctions", "regions", "agents", "vehicles")),
            fixed(row["frames_per_s"], 1), fixed(row["core_ms"], 0),
            fixed(row["gb_per_hour"], 2), ", ".join(shown),
        ],
    ]  # fmt: skip


_LARGE = ("detections", "truth", "sightings", "counts", "stages")


def run_readme(data: dict[str, Any]) -> Table:
    """Returns the README's table of a run."""
    run = data["summary"]
    ms, factor = run["latency_ms"]["end_to_end"], fixed(run["real_time_factor"], 2)
    latency = f"{fixed(ms['p50'], 0)} / {fixed(ms['p95'], 0)} ms"
    mbps = mean(agent["mbps"] for agent in run["agents"].values())
    return [
        ["", "cpnet"],
        ["real-time factor, sensors, edge and SUMO together", factor],
        ["sensing to signal, median / p95, over loopback", latency],
        ["uplink per agent, whole scans at 2 cm error", f"{fixed(mbps, 1)} Mbit/s"],
    ]


def run_text(data: dict[str, Any]) -> str:
    """Returns the head of the summary, its end-to-end latency and the first agents."""
    lines = data["text"].strip().split("\n")
    end = next(i for i, line in enumerate(lines) if "end to end" in line)
    agents = next(i for i, line in enumerate(lines) if line.startswith(" agent "))
    shown = [*lines[:10], " …", lines[end], "", *lines[agents : agents + 4], " …", *lines[-2:]]
    return "\n".join(["```", *shown, "```"])


def text(data: dict[str, str]) -> str:
    """Returns what a command printed."""
    return data["text"].strip()


def as_text(output: str) -> dict[str, str]:
    """Reads what a command printed as it is."""
    return {"text": output}


def summary_and_text(output: str) -> dict[str, Any]:
    """Reads a summary in JSON and what is printed of it, parted by a form feed."""
    summary, text = output.split("\f")
    return {"summary": json.loads(summary), "text": text}
