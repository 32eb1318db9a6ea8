"""The shortest `cpnet up` that reproduces a recorded run."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from typing import Any

from cpnet import scenario as scenarios
from protocol.errors import ConfigError

_OPTIONS = {
    "mode": "--mode",
    "duration_s": "--duration",
    "seed": "--seed",
    "traffic.cav_rate": "--cav-rate",
    "traffic.cv_rate": "--cv-rate",
}


def command_of(recorded: dict[str, Any]) -> str:
    """Returns the shortest `cpnet up` that gives this scenario; empty if none does."""
    if recorded.get("replay"):
        return ""
    recorded = {**recorded, **(recorded.get("asked") or {}), "asked": None}
    name = recorded.get("name")
    base = name if name in scenarios.builtin_names() else "t_junction"
    changed = dict(_changes(recorded, scenarios.load(base, {}).model_dump(mode="json")))
    try:
        again = scenarios.load(base, changed).model_dump(mode="json")
    except ConfigError:  # recorded by a version that knew other keys
        return ""
    if again != recorded:
        return ""
    words = ["cpnet", "up", base]
    for key, value in changed.items():
        words += (
            [_OPTIONS[key], _plain(value)]
            if key in _OPTIONS
            else ["--set", _assignment(key, value)]
        )
    return shlex.join(words)


def _changes(
    recorded: dict[str, Any], default: dict[str, Any], path: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yields the dotted keys whose values differ, in the order of the scenario."""
    for key, value in recorded.items():
        before = default.get(key)
        if isinstance(value, dict) and isinstance(before, dict) and before:
            yield from _changes(value, before, f"{path}{key}.")
        elif value != before or key not in default:
            yield path + key, value


def _assignment(key: str, value: object) -> str:
    """Returns key=value; JSON is YAML, and a plain word needs no quotes."""
    text = value if isinstance(value, str) and _is_plain(value) else json.dumps(value)
    return f"{key}={text}"


def _is_plain(text: str) -> bool:
    return bool(text) and scenarios.parse_assignment(f"key={text}")[1] == text


def _plain(value: object) -> str:
    """Returns a value as people write it: 30, not 30.0."""
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)
