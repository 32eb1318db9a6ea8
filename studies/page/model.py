"""What a page says: text, tables, pictures and charts. How it is drawn is another's matter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from studies.page.charts import Chart, MapChart, Timeline

Cell: TypeAlias = str | float | int | None


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph, as it is: no markup is read in it."""

    text: str


@dataclass(frozen=True, slots=True)
class Code:
    """Text whose lines and spaces count; `folded` hides it until it is asked for."""

    text: str
    title: str = ""
    folded: bool = False


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its name, and how its numbers are written, such as ".2f" or ",d"."""

    name: str
    form: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells; None is a dash. A form that a cell is not made for leaves it as it is."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str = ""

    def __post_init__(self) -> None:
        """Refuses rows of another width than the head."""
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a row of {len(row)} cells under {len(self.columns)} columns")


@dataclass(frozen=True, slots=True)
class Picture:
    """A PNG, by its file or its bytes."""

    source: Path | bytes
    caption: str

    def data(self) -> bytes:
        """Returns the bytes of the file.

        Raises:
            OSError: the file cannot be read.
        """
        return self.source if isinstance(self.source, bytes) else self.source.read_bytes()


Figure: TypeAlias = Chart | MapChart | Timeline


@dataclass(frozen=True, slots=True)
class Beside:
    """Blocks next to each other where the page is wide enough, else one below the other."""

    blocks: tuple[Block, ...]


Block: TypeAlias = Text | Code | Table | Picture | Chart | MapChart | Timeline | Beside


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page under its own title."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True, slots=True)
class Fact:
    """A headline figure, ready to be read, and what it is."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Page:
    """A whole page; `facts` stand at its top."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    facts: tuple[Fact, ...] = ()

    def figures(self) -> list[Figure]:
        """Returns all charts in the order in which they are read."""
        return [
            block
            for section in self.sections
            for block in flat(section.blocks)
            if isinstance(block, Chart | MapChart | Timeline)
        ]


def flat(blocks: tuple[Block, ...]) -> list[Block]:
    """Returns blocks with those that stand beside each other one after the other."""
    found: list[Block] = []
    for block in blocks:
        found += flat(block.blocks) if isinstance(block, Beside) else [block]
    return found
