"""How a run was made: the command, the versions, the scenario."""

from __future__ import annotations

import json

import yaml

from recorder.run import Run
from studies.page.model import Block, Cell, Code, Column, Section, Table, Text


def origin_section(run: Run, command: str) -> Section:
    """Returns what is needed to make the run again."""
    blocks: list[Block] = []
    if command:
        blocks.append(Code(command, "The command that makes this run again"))
    else:
        blocks.append(Text("The command is not known: this version does not take the scenario."))
    rows = _versions(run)
    blocks.append(Table((Column("made with"), Column("version")), rows))
    if run.scenario:
        text = yaml.safe_dump(run.scenario, sort_keys=False, allow_unicode=True)
        blocks.append(Code(text, "The scenario, with every default", folded=True))
    else:
        blocks.append(Text("No scenario was recorded."))
    return Section("How it was made", tuple(blocks))


def _versions(run: Run) -> tuple[tuple[Cell, ...], ...]:
    try:
        found = json.loads(run.meta.get("versions", "{}"))
    except ValueError:
        found = {}
    if not isinstance(found, dict) or not found:  # a run from before all of them were kept
        found = {"cpnet-edge": run.meta.get("version", "unknown")}
    started = run.meta.get("started")
    return (
        *((str(k), str(v)) for k, v in found.items()),
        *([("started", started)] if started else []),
    )
