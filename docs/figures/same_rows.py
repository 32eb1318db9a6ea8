"""`scripts/figures --same`: figures of rows outlive a change that leaves rows as they were.

A faster loop or an error's words change the code and nothing that it measures. The runs of
`same_rows.yaml` are made with the code of the commit that was measured and with the code as it is;
where all their rows are the same, the figure says so instead of being older than its code.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

RUNS = "docs/figures/same_rows.yaml"


def _runs(root: Path, work: Path, name: str) -> dict[str, Path]:
    """Makes the runs with the code in a folder, unless they are there; returns their folders.

    By title: a run's folder is named after the code that it is of, too.

    Raises:
        subprocess.CalledProcessError: one failed.
    """
    out = work / name
    command = [sys.executable, "-m", "cpnet", "study", str(work / "same_rows.yaml")]
    subprocess.run(
        [*command, "--keep-runs", "--out", str(out)],
        cwd=work,
        env=os.environ | {"PYTHONPATH": str(root)},
        stdout=sys.stderr,
        check=True,
    )
    cells = [json.loads(one.read_text("utf-8")) for one in (out / "cells").glob("*.json")]
    return {cell["title"]: out / "runs" / cell["id"] for cell in cells}


def differing(root: Path, work: Path, commit: str) -> tuple[int, list[str]]:
    """Compares the code in the folder `root` with a commit; returns how many runs, what differs.

    Raises:
        subprocess.CalledProcessError: a run failed, or there is no such commit.
    """
    from recording.run import differences

    shutil.rmtree(work / "now", ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    shutil.copy(root / RUNS, work)
    then = work / f"tree-{commit[:7]}"
    if not then.exists():
        add = ["git", "worktree", "add", "-q", "--detach", str(then), commit]
        subprocess.run(add, cwd=root, check=True)
    try:
        before, now = _runs(then, work, f"at-{commit[:7]}"), _runs(root, work, "now")
    finally:
        subprocess.run(["git", "worktree", "remove", "--force", str(then)], cwd=root, check=True)
    found = [
        f"{title}: {one}"
        for title, run in sorted(now.items())
        for one in differences(run, before[title])
    ]
    return len(now), found
