"""`scripts/figures`: makes the tables and pictures of README and docs again, one command each.

Each figure of the registry has a file `docs/figures/NAME.json`: what was measured, by which
command, at which commit, on what machine, in how long, and a digest of all that made it. Pages show
its parts between `<!-- figure: NAME.PART -->` and `<!-- /figure -->`; below stands its age. It is
older than its command, study file and code if the digest is another one now. What is fresh is not
measured again, so that an interrupted call goes on where it was. `--same` finds out whether the
code is still that of the commit measured, or a change of it left the rows of runs as they were, see
`same_rows`; then figures are fresh still.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import io
import json
import os
import re
import subprocess
import sys
import time
import tokenize
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from figure import OTHER_COMMANDS, Figure, Part
from registry import FIGURES, LEARNED
from same_rows import compared, compared_policies, tree_of

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(__file__).resolve().parent
WORK = ROOT / "runs" / "figures"  # data sets and runs of the commands, kept
_BLOCK = re.compile(r"<!-- figure: ([\w.-]+) -->\n.*?<!-- /figure -->\n?", re.DOTALL)
_RECIPES = re.compile(r"\$ROOT/(docs/figures/[\w.]+)")  # studies and scripts of commands

Record = dict[str, Any]


def digest(figure: Figure, root: Path | None = None) -> str:
    """Returns a hash of the command and the files that it measures; of Python what is executed."""
    found = hashlib.sha256(figure.command.encode())
    root = root or ROOT
    for path in _sources(figure, root):
        found.update(f"{path.relative_to(root)}\0".encode())
        found.update(
            executed(path.read_text("utf-8")) if path.suffix == ".py" else path.read_bytes()
        )
    return found.hexdigest()[:16]


@cache
def executed(source: str) -> bytes:
    """Returns Python code without comments, docstrings and empty lines."""
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            first, last = node.lineno - 1, node.end_lineno or node.lineno
            lines[first:last] = [""] * (last - first)
    return "\n".join(line.rstrip() for line in lines if line.strip()).encode()


def _sources(figure: Figure, root: Path) -> Iterator[Path]:
    for name in (*figure.sources, *_RECIPES.findall(figure.command)):
        path = root / name
        if not path.exists():
            raise FileNotFoundError(f"figure {figure.name}: there is no {name} to measure")
        yield from (
            [path]
            if path.is_file()
            else (
                p
                for p in sorted(path.rglob("*"))
                if p.is_file()
                and "__pycache__" not in p.parts
                and not any(p.match(other) for other in OTHER_COMMANDS)
            )
        )


def load(figure: Figure) -> Record | None:
    """Returns what was measured last, if anything."""
    path = FOLDER / f"{figure.name}.json"
    return json.loads(path.read_text("utf-8")) if path.exists() else None


def is_fresh(figure: Figure) -> bool:
    """Tells whether the code is that which was measured, or gives the same rows."""
    record = load(figure)
    if record is None:
        return False
    return digest(figure) in (record["sources"], record.get("same", {}).get("sources"))


def age(figure: Figure, record: Record) -> str:
    """Returns in words when a figure was measured, and whether the code has changed since."""
    if record["commit"] is None:
        return "measured before commits were recorded; the code has changed since"
    machine = record["machine"]
    measured = (
        f"measured at commit {record['commit'][:7]}, {record['date']}, "
        f"{machine['cores']} cores, {machine['cpu']}"
    )
    if not is_fresh(figure):
        return f"{measured}; the code has changed since"
    if record["sources"] == digest(figure):
        return measured
    same = record["same"]
    if not same["runs"]:
        return f"{measured}; what it measures has not changed since"
    return f"{measured}; in {same['runs']} runs commit {same['commit'][:7]} gives the same rows"


def compare_code(names: list[str]) -> None:
    """Marks the older figures whose code is still that of the commit compared, else measured.

    So it is where the list of what a figure measures has become shorter, or a change was undone.
    Says of each what was found.
    """
    for figure in FIGURES.values():
        record = load(figure)
        chosen = not names or figure.name in names
        if not chosen or not record or not record["commit"] or is_fresh(figure):
            continue
        known = record.get("same") or {}
        if not known.get("runs"):
            known = {"commit": record["commit"], "runs": 0}
        was_measured = record.get("is_committed", True) and record["command"] == figure.command
        is_same = was_measured and _was_same(figure, known["commit"])
        says = "the same code as" if is_same else "not the code"
        sys.stderr.write(f"{figure.name}: {says} at {known['commit'][:7]}\n")
        if is_same:
            save(figure, record | {"same": known | {"sources": digest(figure)}})


def _was_same(figure: Figure, commit: str) -> bool:
    """Whether a commit has the code that a figure measures; not where one of them is missing."""
    try:
        with tree_of(ROOT, WORK / "same", commit) as tree:
            return digest(figure, tree) == digest(figure)
    except (FileNotFoundError, subprocess.CalledProcessError):
        return False


def compare_rows(names: list[str]) -> None:
    """Marks the older figures of rows whose code still gives the rows that were measured.

    Runs of a learned detector count for the figures that show one; so do runs with tracks, and
    those under predictive control. Figures of policies on SUMO alone are compared by runs of these.

    Raises:
        subprocess.CalledProcessError: a run failed, or a commit is not there any more.
    """
    older: dict[tuple[str, bool], list[Figure]] = {}
    for figure in FIGURES.values():
        record = load(figure)
        chosen = (figure.of_rows or figure.of_policies) and (not names or figure.name in names)
        if chosen and record and record["commit"] and not is_fresh(figure):
            older.setdefault((record["commit"], figure.of_policies), []).append(figure)
    for (commit, of_policies), figures in older.items():
        now = _git("rev-parse", "HEAD")
        comparison = compared_policies if of_policies else compared
        every = comparison(ROOT, WORK / "same", commit, now)
        for figure in figures:
            runs = [
                run
                for run in every
                if (figure.learned or run.detector not in LEARNED)
                and (figure.tracked or not run.is_tracked)
                and (figure.predictive or not run.is_predictive)
            ]
            found = [f"{run.title}: {one}" for run in runs for one in run.differences]
            says = "\n  ".join(found) or f"the same rows in {len(runs)} runs"
            sys.stderr.write(f"{figure.name}, measured at {commit[:7]}: {says}\n")
            if runs and not found:
                same = {"commit": now, "sources": digest(figure), "runs": len(runs)}
                save(figure, (load(figure) or {}) | {"same": same})


def measure(figure: Figure) -> None:
    """Runs a figure's command and keeps what it says, even if it cannot be laid out.

    Raises:
        subprocess.CalledProcessError: the command failed.
    """
    WORK.mkdir(parents=True, exist_ok=True)
    sources, begin = digest(figure), time.monotonic()
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "ROOT": str(ROOT)}
    done = subprocess.run(
        ["/bin/sh", "-euc", figure.command],
        cwd=WORK,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    minutes = (time.monotonic() - begin) / 60
    data = {"files": figure.digests(ROOT)} if figure.files else figure.read(done.stdout)
    record: Record = {
        "command": figure.command,
        "commit": _git("rev-parse", "HEAD"),
        "is_committed": not _git("status", "--porcelain", "--", *figure.sources),
        "date": datetime.now(UTC).date().isoformat(),
        "machine": {"cpu": _cpu(), "cores": os.cpu_count()},
        "minutes": round(minutes, 1),
        "sources": sources,
        "data": data,
        "parts": (load(figure) or {}).get("parts", {}),
    }
    _write(figure, record)
    save(figure, record)


def refresh(figure: Figure, record: Record) -> Record:
    """Returns the record with its parts as the registry lays out the data that were measured."""
    if record["data"] is None or figure.files:
        return record
    parts = {p.name: p.layout(record["data"]) if p.layout else None for p in figure.parts}
    kept = {name: record["parts"].get(name) if one is None else one for name, one in parts.items()}
    return record | {"parts": kept}


def save(figure: Figure, record: Record) -> None:
    """Writes what was measured, with its parts as pages show them."""
    _write(figure, refresh(figure, record))


def _write(figure: Figure, record: Record) -> None:
    lines = (f'"{key}": {_dumped(value)}' for key, value in record.items())
    text = "{\n" + ",\n".join(lines) + "\n}\n"
    (FOLDER / f"{figure.name}.json").write_text(text, "utf-8")


def _dumped(value: object) -> str:
    """Returns JSON with a line for each entry of a list or map."""
    if isinstance(value, list) and value:
        return "[\n " + ",\n ".join(json.dumps(one, ensure_ascii=False) for one in value) + "\n]"
    if isinstance(value, dict) and value:
        lines = (f'"{key}": {json.dumps(one, ensure_ascii=False)}' for key, one in value.items())
        return "{\n " + ",\n ".join(lines) + "\n}"
    return json.dumps(value, ensure_ascii=False)


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def _cpu() -> str:
    names = [
        line.split(":")[1].strip()
        for line in Path("/proc/cpuinfo").read_text("utf-8").splitlines()
        if line.startswith("model name")
    ]
    return names[0] if names else "unknown processor"


def written(page: str) -> str:
    """Returns a page's text with all of its figures as they are in the JSON files."""
    blocks = {}
    for figure in FIGURES.values():
        record = load(figure)
        if record is not None:
            for part in figure.parts:
                if part.page == page:
                    name = f"{figure.name}.{part.name}"
                    blocks[name] = _block(name, figure, part, refresh(figure, record))

    def put(found: re.Match[str]) -> str:
        if found[1] not in blocks:
            raise KeyError(f"{page}: figure {found[1]} is not in the registry, or has no data")
        return blocks[found[1]]

    text = (ROOT / page).read_text("utf-8")
    missing = set(blocks) - set(_BLOCK.findall(text))
    is_written_whole = any(page in figure.files for figure in FIGURES.values())
    for name in sorted(missing):
        if not is_written_whole:
            raise KeyError(f"{page}: shows no figure {name}")
        title, rest = text.split("\n", 1)
        text = f"{title}\n\n<!-- figure: {name} -->\n<!-- /figure -->\n{rest}"
    return _BLOCK.sub(put, text)


def _block(name: str, figure: Figure, part: Part, record: Record) -> str:
    shown = record["parts"].get(part.name)
    body = f"{shown}\n\n" if isinstance(shown, str) else f"{_table(shown)}\n\n" if shown else ""
    return f"<!-- figure: {name} -->\n{body}*{age(figure, record)}*\n<!-- /figure -->\n"


def _table(rows: list[list[str]]) -> str:
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    ruled = [" | ".join(line) for line in lines]
    return "\n".join(f"| {line} |".replace("|  |", "| |") for line in ruled)


def pages() -> list[str]:
    """Returns all pages that show figures."""
    return sorted({part.page for figure in FIGURES.values() for part in figure.parts})


def _list() -> None:
    for figure in FIGURES.values():
        record = load(figure)
        state = "fresh" if is_fresh(figure) else "older" if record else "missing"
        when = (record["date"] or "unknown") if record else "never"
        command = figure.command or "by hand"
        line = f"{figure.name:16} {state:8} {when:10} {figure.minutes:3d} min  {command}"
        sys.stdout.write(line + "\n")


def main() -> None:
    """Measures what is older than its code, and writes the pages."""
    parser = argparse.ArgumentParser(prog="scripts/figures", description=main.__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="figures; else all")
    parser.add_argument("--list", action="store_true", help="name, age, minutes, command")
    parser.add_argument("--write", action="store_true", help="write the pages, measure nothing")
    parser.add_argument("--again", action="store_true", help="measure what is fresh, too")
    parser.add_argument(
        "--same", action="store_true", help="measure nothing; compare code and rows with those then"
    )
    parser.add_argument("--within", type=int, help="leave out what takes more minutes than this")
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(FIGURES))
    if unknown:
        parser.error(f"no figure {unknown[0]}: must be one of {', '.join(FIGURES)}")
    if options.list:
        _list()
        return
    if options.same:
        compare_code(options.names)
        compare_rows(options.names)
    for figure in [] if options.write or options.same else FIGURES.values():
        chosen = not options.names or figure.name in options.names
        quick = options.within is None or figure.minutes <= options.within
        if chosen and quick and figure.command and (options.again or not is_fresh(figure)):
            sys.stderr.write(f"{figure.name}, about {figure.minutes} min: {figure.command}\n")
            measure(figure)
    for figure in FIGURES.values():
        if (record := load(figure)) is not None:
            save(figure, record)
    for page in pages():
        (ROOT / page).write_text(written(page), "utf-8")


if __name__ == "__main__":
    main()
