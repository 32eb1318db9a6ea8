"""A page as Markdown, its charts and pictures as PNG files beside it."""

from __future__ import annotations

import re
from itertools import count
from pathlib import Path

from studies.page.cells import numeric, rows_of
from studies.page.charts import Chart, MapChart, Timeline
from studies.page.colours import Colours
from studies.page.model import Beside, Block, Code, Figure, Page, Picture, Table, Text
from studies.page.png import save_png

_MARKS = re.compile(r"([\\`*_\[\]<>#|~$&])")


def to_markdown(page: Page, folder: Path, stem: str) -> str:
    """Writes `STEM-N.png` into a folder and returns the text that shows them from beside it.

    Raises:
        OSError: the folder cannot be written, or a picture's file cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    writer = _Writer(Colours.of(page), folder, stem)
    parts = [f"# {plain(page.title)}"]
    parts += [plain(page.lead)] if page.lead else []
    if page.facts:
        rows = [[one.name, one.value, one.note] for one in page.facts]
        parts.append(_grid(["", "", ""], rows, [False, True, False]))
    for section in page.sections:
        parts.append(f"## {plain(section.title)}")
        parts += [writer.text(block) for block in section.blocks]
    return "\n\n".join(parts) + "\n"


class _Writer:
    """Blocks as Markdown; pictures are numbered in reading order."""

    def __init__(self, colours: Colours, folder: Path, stem: str) -> None:
        self._colours, self._folder, self._stem = colours, folder, stem
        self._numbers = count(1)

    def text(self, block: Block) -> str:
        """Returns a block as Markdown and writes its picture, if it is one."""
        if isinstance(block, Beside):
            return "\n\n".join(self.text(one) for one in block.blocks)
        if isinstance(block, Chart | MapChart | Timeline):
            return self._figure(block)
        if isinstance(block, Picture):
            path = self._next()
            path.write_bytes(block.data())
            return self._shown(path, block.caption)
        if isinstance(block, Table):
            return _table(block)
        return _fenced(block) if isinstance(block, Code) else _paragraph(block)

    def _figure(self, figure: Figure) -> str:
        path = self._next()
        save_png(figure, self._colours, path)
        notes = f"\n\n{plain(figure.notes)}" if figure.notes else ""
        return self._shown(path, figure.title) + notes

    def _next(self) -> Path:
        return self._folder / f"{self._stem}-{next(self._numbers)}.png"

    def _shown(self, path: Path, caption: str) -> str:
        """Links a picture as seen from the file that lies beside its folder."""
        return f"![{plain(caption)}]({self._folder.name}/{path.name})"


def plain(text: str) -> str:
    """Returns text in which Markdown finds no marks, on one line."""
    return _MARKS.sub(r"\\\1", " ".join(text.split()))


def _paragraph(block: Text) -> str:
    return plain(block.text)


def _fenced(block: Code) -> str:
    longest = max((len(run) for run in re.findall(r"`+", block.text)), default=0)
    fence = "`" * max(3, longest + 1)
    title = f"{plain(block.title)}:\n\n" if block.title else ""
    return f"{title}{fence}\n{block.text.rstrip()}\n{fence}"


def _table(table: Table) -> str:
    caption = f"**{plain(table.caption)}**\n\n" if table.caption else ""
    return caption + _grid([c.name for c in table.columns], rows_of(table), numeric(table))


def _grid(head: list[str], rows: list[list[str]], on_right: list[bool]) -> str:
    rule = ["--:" if right else "---" for right in on_right]
    lines = [[plain(cell) for cell in row] for row in (head, *rows)]
    lines.insert(1, rule)
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
