"""Prints how well the kept runs of a study were tracked: `track_scores.py RESULTS`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from studies.run_tracks import evaluate_run
from studies.sweep.cells import identify


def main() -> None:
    """Prints a row for each run: its labels, and what `cpnet eval --tracks RUN --json` says."""
    out, rows = Path(sys.argv[1]), []
    for path in sorted((out / "cells").glob("*.json")):
        cell = json.loads(path.read_text("utf-8"))
        if identify(cell["scenario"]) != cell["id"]:
            continue  # of older code
        found = evaluate_run(out / "runs" / cell["id"])
        rows.append({"title": cell["title"], **found.as_json()})
    json.dump(sorted(rows, key=lambda row: row["title"]), sys.stdout)


if __name__ == "__main__":
    main()
