"""Mutation testing: which changes of the code the tests of its package do not notice.

`scripts/mutate [PART ...]` mutates the sources of each part by mutmut, in a copy of the tree, runs
the tests of that part against every mutant, and writes the scores to scores.json beside this file.
A surviving mutant needs a reason in survivors.yaml beside this file; new ones are added without
one. mutmut leaves functions under a decorator alone, compiled ones among them.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
SURVIVORS = Path(__file__).with_name("survivors.yaml")
SCORES = Path(__file__).with_name("scores.json")
REQUIRED_SCORE = 0.85
KILLED = {1, 3, 24, 36, 152, -24, 255}  # mutmut's exit codes: a test failed, was too slow, or died
UNTESTED = 33


@dataclass(frozen=True)
class Part:
    """Source files and the tests that must notice their mutants."""

    sources: list[str]
    tests: list[str]


PARTS = {
    "cabinet": Part(
        ["sim_host/cabinet.py"],
        [
            "tests/sim_host/test_cabinet.py",
            "tests/sim_host/test_pending.py",
            "tests/sim_host/test_actuated.py",
            "tests/sim_host/test_hostile_requests.py",
        ],
    ),
    "policies": Part(
        ["signal_controller/policies.py"],
        [
            "tests/signal_controller/test_policies.py",
            "tests/signal_controller/test_policy_of.py",
            "tests/signal_controller/test_signal_role.py",
        ],
    ),
    "queues": Part(
        ["signal_controller/queue_estimator.py"],
        [
            "tests/signal_controller/test_queue_estimator.py",
            "tests/signal_controller/test_policies.py",
        ],
    ),
    "pipeline": Part(["edge_server/pipeline.py"], ["tests/edge_server/test_edge_pipeline.py"]),
    "placing": Part(["edge_server/placing.py"], ["tests/edge_server/test_placing.py"]),
    "fusion": Part(["edge_server/fusion.py"], ["tests/edge_server/test_fusion.py"]),
    "lanes": Part(
        ["edge_server/lanes.py"],
        ["tests/edge_server/test_lane_counts.py"],
    ),
    "coverage": Part(
        ["edge_server/coverage.py"],
        ["tests/edge_server/test_lane_coverage.py", "tests/edge_server/test_cell_borders.py"],
    ),
    "misbehaviour": Part(
        ["edge_server/misbehaviour.py"], ["tests/edge_server/test_misbehaviour.py"]
    ),
    "tracker": Part(
        [
            f"perception/tracking/{name}.py"
            for name in ("tracker", "association", "life_cycle", "motion", "pairing", "places")
        ],
        ["tests/perception/test_tracking.py"],
    ),
    "rows": Part(["recording/rows.py"], ["tests/recording/test_tables.py"]),
    "codec": Part(
        ["protocol/codec/forms.py"],
        ["tests/protocol/test_codec.py", "tests/protocol/test_codec_rings.py"],
    ),
}


def tree_with_config(part: Part, folder: Path) -> None:
    """Copies the tracked files and adds mutmut's section to pyproject.toml."""
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(lambda name: (ROOT / name).is_file(), names.splitlines()):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    packages = sorted({path.parent.name for path in ROOT.glob("*/py.typed")})
    others = [p.name for p in folder.iterdir() if p.name not in {*packages, "tests"}]
    section = {
        "source_paths": packages,
        "only_mutate": part.sources,
        "also_copy": others,
        "pytest_add_cli_args": ["-p", "no:xdist", "-p", "no:cacheprovider", "-m", "not slow"],
        "pytest_add_cli_args_test_selection": part.tests,
    }
    lines = [f"{key} = {json.dumps(value)}" for key, value in section.items()]
    with (folder / "pyproject.toml").open("a") as config:
        config.write("\n[tool.mutmut]\n" + "\n".join(lines) + "\n")


def mutmut(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs mutmut in the copy, so that the copy's code is what is imported."""
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, "-m", "mutmut", *arguments]
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)


def outcomes(folder: Path, source: str) -> dict[str, int | None]:
    """Returns the exit code of each mutant's tests by its name; None was not run."""
    meta = folder / "mutants" / f"{source}.meta"
    if not meta.is_file():
        sys.exit(f"mutmut left nothing for {source}: it has no mutants, or its tests fail")
    return dict(json.loads(meta.read_text())["exit_code_by_key"])


def function_of(mutant: str) -> str:
    """Returns the dotted name of the function that a mutant changes."""
    name = mutant.rpartition("__mutmut_")[0]
    module, _, function = name.rpartition(".")
    parts = function.removeprefix("xǁ").removeprefix("x_").split("ǁ")
    return ".".join([module, *parts])


def change_of(folder: Path, mutant: str) -> str:
    """Returns the lines of the mutant's diff that differ."""
    shown = mutmut(folder, "show", mutant).stdout.splitlines()
    body = [line for line in shown if line[:1] in "+-" and line[:3] not in {"+++", "---"}]
    return "\n".join(line[0] + " " + line[1:].strip() for line in body)


def measure(part: Part) -> tuple[dict[str, Any], list[dict[str, str]]]:
    """Returns mutants and killed ones by source file, and what survived."""
    with TemporaryDirectory(prefix="cpnet-mutation-") as name:
        folder = Path(name)
        tree_with_config(part, folder)
        done = mutmut(folder, "run", "--max-children", "2")
        scores, survivors = {}, list[dict[str, str]]()
        for source in part.sources:
            codes = outcomes(folder, source)
            if None in codes.values():
                sys.exit(f"mutmut stopped early:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
            lived = [mutant for mutant, code in codes.items() if code not in KILLED]
            scores[source] = {"mutants": len(codes), "killed": len(codes) - len(lived)}
            survivors += [
                {"function": function_of(mutant), "change": change_of(folder, mutant)}
                for mutant in lived
            ]
    return scores, survivors


def _of(survivor: dict[str, str], modules: set[str]) -> bool:
    """Returns whether a survivor is of one of the modules, whose names end in a dot."""
    return survivor["function"].startswith(tuple(modules))


def with_reasons(found: list[dict[str, str]], modules: set[str]) -> list[dict[str, str]]:
    """Returns all survivors: other modules' as listed, the found ones with their reasons."""
    listed = yaml.safe_load(SURVIVORS.read_text()) if SURVIVORS.is_file() else None
    known = {(s["function"], s["change"]): s["reason"] for s in listed or []}
    others = [s for s in listed or [] if not _of(s, modules)]
    mine = [s | {"reason": known.get((s["function"], s["change"]), "")} for s in found]
    return sorted(others + mine, key=lambda s: (s["function"], s["change"]))


def main() -> None:
    """Measures the parts named, or all; fails below the required score or without a reason."""
    parts = sys.argv[1:] or list(PARTS)
    unknown = sorted(set(parts) - set(PARTS))
    if unknown:
        sys.exit(f"no part {unknown[0]!r}: must be one of {', '.join(PARTS)}")
    table = json.loads(SCORES.read_text()) if SCORES.is_file() else {}
    weak, silent = [], []
    for name in parts:
        scores, survivors = measure(PARTS[name])
        modules = {source.removesuffix(".py").replace("/", ".") + "." for source in scores}
        every = with_reasons(survivors, modules)
        SURVIVORS.write_text(yaml.safe_dump(every, sort_keys=False, allow_unicode=True))
        silent += [s["function"] for s in every if not s["reason"] and _of(s, modules)]
        for source, score in scores.items():
            table[source] = score
            share = score["killed"] / max(score["mutants"], 1)
            print(
                f"{source:45} {score['killed']:5} of {score['mutants']:5} {share:6.1%}", flush=True
            )
        killed, mutants = (sum(s[key] for s in scores.values()) for key in ("killed", "mutants"))
        weak += [name] if killed < REQUIRED_SCORE * mutants else []
        SCORES.parent.mkdir(exist_ok=True)
        SCORES.write_text(json.dumps(dict(sorted(table.items())), indent=1) + "\n")
    if weak:
        sys.exit(f"fewer than {REQUIRED_SCORE:.0%} of the mutants are killed: {', '.join(weak)}")
    if silent:
        names = ", ".join(sorted(set(silent)))
        sys.exit(f"survivors without a reason in {SURVIVORS.name}: {names}")


if __name__ == "__main__":
    main()
