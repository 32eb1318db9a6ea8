"""Whether SUMO runs; in a process of its own, for a library may end its process."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

from cpnet.deaths import signal_name
from cpnet.doctor.finding import Finding

TRIAL_TIMEOUT_S = 15


def starts() -> list[Finding]:
    """Has SUMO simulate a step; nothing to say where it is not installed."""
    if not all(map(importlib.util.find_spec, ("sumo", "libsumo"))):
        return []
    command = [sys.executable, "-m", "sim_host.sumo"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=TRIAL_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return [_found("SUMO", f"it did not simulate one step in {TRIAL_TIMEOUT_S} s")]
    if done.returncode == 0:
        return [_found(f"{done.stdout.strip().splitlines()[-1]} simulates a step", "")]
    return [_found("SUMO", f"{_how(done.returncode)}{_last_line(done.stderr)}")]


def _found(what: str, advice: str) -> Finding:
    return Finding("sumo", what, not advice, advice)


def _how(status: int) -> str:
    return f"it was killed by {signal_name(-status)} " if status < 0 else ""


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it ended without a word"])[-1][:300]
