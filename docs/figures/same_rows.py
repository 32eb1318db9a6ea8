"""`scripts/figures --same`: figures of rows outlive a change that leaves rows as they were.

A faster loop or an error's words change the code and nothing that it measures. The runs of
`same_rows.yaml` are made with the code of the commit that was measured and with the code as it is;
where all their rows are the same, the figure says so instead of being older than its code.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

RUNS = "docs/figures/same_rows.yaml"
POLICIES = (
    "bench control --net t_junction --net moving_peak --net corridor --net grid --policies "
    "webster,actuated,max_pressure,max_wave,predictive --duration 300 --processes 2 --json"
)
"""What figures of signal policies on SUMO alone are compared by."""


@dataclass(frozen=True, slots=True)
class Compared:
    """A run's title, its detector, and what differs; nothing where all rows are the same."""

    title: str
    detector: str
    is_tracked: bool
    is_predictive: bool
    differences: list[str]


def compared(root: Path, work: Path, then: str, now: str) -> list[Compared]:
    """Compares the code in the folder `root`, which is that of the commit `now`, with another's.

    Runs that were made are kept.

    Raises:
        subprocess.CalledProcessError: a run failed, or there is no such commit.
    """
    from recording.run import differences

    work.mkdir(parents=True, exist_ok=True)
    shutil.copy(root / RUNS, work)
    made = _made(root, work, now)
    with tree_of(root, work, then) as tree:
        before = _made(tree, work, then)
    return [
        Compared(
            title,
            made[title].detector,
            made[title].is_tracked,
            made[title].is_predictive,
            [*differences(made[title].run, before[title].run)],
        )
        for title in sorted(made)
    ]


def compared_policies(root: Path, work: Path, then: str, now: str) -> list[Compared]:
    """Compares what policies do on SUMO alone, as `compared` does runs with perception.

    Raises:
        subprocess.CalledProcessError: a run failed, or there is no such commit.
    """
    work.mkdir(parents=True, exist_ok=True)
    after = _benched(root, work, now)
    with tree_of(root, work, then) as tree:
        before = _benched(tree, work, then)
    return [
        Compared(
            one, "none", False, False, [] if before.get(one) == after.get(one) else ["other rows"]
        )
        for one in sorted(before.keys() | after.keys())
    ]


def _benched(root: Path, work: Path, commit: str) -> dict[str, Any]:
    """Returns the rows of `POLICIES`, without times, by net, policy, seed; what was made is kept.

    Raises:
        ValueError: there are none.
    """
    digest = hashlib.sha256(POLICIES.encode()).hexdigest()
    out = work / f"policies-{commit[:7]}-{digest[:7]}.json"
    if not out.exists():
        done = subprocess.run(
            [sys.executable, "-m", "cpnet", *POLICIES.split()],
            cwd=work,
            env=os.environ | {"PYTHONPATH": str(root)},
            stdout=subprocess.PIPE,
            check=True,
        )
        out.write_bytes(done.stdout)
    rows = json.loads(out.read_text("utf-8"))
    if not rows:
        raise ValueError(f"{out} has no rows to compare")
    return {
        f"{row['net']}, {row['policy']}, seed {row['seed']}": {
            key: value for key, value in row.items() if not key.startswith("decide_")
        }
        for row in rows
    }


@dataclass(frozen=True, slots=True)
class _Made:
    run: Path
    detector: str
    is_tracked: bool
    is_predictive: bool


@contextmanager
def tree_of(root: Path, work: Path, commit: str) -> Iterator[Path]:
    """Yields a worktree of its own with the code of a commit."""
    tree = work / f"tree-{commit[:7]}"
    if not tree.exists():
        add = ["git", "worktree", "add", "-q", "--detach", str(tree), commit]
        subprocess.run(add, cwd=root, check=True)
    try:
        yield tree
    finally:
        subprocess.run(["git", "worktree", "remove", "--force", str(tree)], cwd=root, check=True)


def _made(root: Path, work: Path, commit: str) -> dict[str, _Made]:
    """Makes those runs that are not there with the code in a folder; returns all by their titles.

    By title, for a run's folder is named after the code that it is of, too; so what was made of
    another list of runs stands elsewhere.
    """
    runs = hashlib.sha256((work / "same_rows.yaml").read_bytes()).hexdigest()
    out = work / f"at-{commit[:7]}-{runs[:7]}"
    command = [sys.executable, "-m", "cpnet", "study", str(work / "same_rows.yaml")]
    subprocess.run(
        [*command, "--keep-runs", "--out", str(out)],
        cwd=work,
        env=os.environ | {"PYTHONPATH": str(root)},
        stdout=sys.stderr,
        check=True,
    )
    cells = [json.loads(one.read_text("utf-8")) for one in (out / "cells").glob("*.json")]
    return {
        cell["title"]: _Made(
            out / "runs" / cell["id"],
            cell["scenario"]["edge"]["detector"],
            cell["scenario"]["edge"]["tracking"]["enabled"],
            cell["scenario"]["signal"]["policy"] == "predictive",
        )
        for cell in cells
    }
