"""How a study was made: the command, the versions, the file."""

from __future__ import annotations

import yaml

from studies.of_study.findings import Findings
from studies.page.model import Block, Code, Column, Section, Table


def origin_section(findings: Findings) -> Section:
    """Returns what is needed to make the study again."""
    text = yaml.safe_dump(
        findings.study.model_dump(by_alias=True), sort_keys=False, allow_unicode=True
    )
    blocks: list[Block] = [Code(findings.command, "The command that makes this again")]
    if findings.versions:
        rows = tuple(findings.versions.items())
        blocks.append(Table((Column("made with"), Column("version")), rows))
    blocks.append(Code(text, "The study, with what was set on the command line", folded=True))
    return Section("How it was made", tuple(blocks))
