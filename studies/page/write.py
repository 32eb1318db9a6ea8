"""Pages as files: HTML that needs no other file, or Markdown with its pictures beside it.

Libraries for drawing and layout are imported when a page is written: a run needs none of them.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Callable
from functools import cache
from importlib import resources
from itertools import count
from pathlib import Path
from typing import Any, Literal

from protocol.config import is_folder
from protocol.errors import ConfigError
from protocol.extras import to_install
from studies.page.model import (
    Block,
    Chart,
    Code,
    Colours,
    Figure,
    MapChart,
    Page,
    SideBySide,
    Table,
    Text,
    Timeline,
    numeric_columns,
    text_rows,
)

_ENDS = {"--html": (".html", ".htm"), "--markdown": (".md",)}
_LISTED_FROM = 4  # sections, for a table of contents
_MARKS = re.compile(r"([\\`*_\[\]<>#|~$&])")


def save_html(page: Page, path: Path) -> None:
    """Writes a page as one HTML file.

    Raises:
        ConfigError: the file cannot be written, or a library is missing.
    """
    _save(path, "--html", "study", lambda: to_html(page))


def save_markdown(page: Page, path: Path) -> None:
    """Writes a page as Markdown, its figures into the folder that is named like the file.

    Raises:
        ConfigError: the file cannot be written, or a library is missing.
    """
    folder = path.parent / path.stem
    _save(path, "--markdown", "plot", lambda: to_markdown(page, folder, path.stem))


def _save(path: Path, option: str, extra: str, rendered: Callable[[], str]) -> None:
    check_target(path, option)
    try:
        text = rendered()
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{option} needs {error.name} (extra `{extra}`): {to_install(extra)}"
        ) from None
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from None


def check_target(path: Path, option: str) -> None:
    """Checks that a page can be written to a path, before it is made.

    The end of its name must be the option's, lest a run or a table be overwritten by its report.

    Raises:
        ConfigError: its name ends otherwise, it is a folder, or its own folder is missing.
    """
    ends = _ENDS[option]
    if is_folder(path):
        raise ConfigError(f"{option} {path}: is a folder; name a file in it")
    if path.suffix.lower() not in ends:
        raise ConfigError(f"{option} {path}: its name must end with {' or '.join(ends)}")
    if not is_folder(path.parent):
        raise ConfigError(f"{option} {path}: there is no folder {path.parent}; make it first")


def to_html(page: Page) -> str:
    """Returns the page; the same page gives the same text."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    template = environment.from_string(_asset("page.html.j2"))
    writer = _HtmlBlocks(Colours.of(page))
    sections = [
        {"id": f"s{number}", "title": one.title, "blocks": [writer.view(b) for b in one.blocks]}
        for number, one in enumerate(page.sections, 1)
    ]
    return template.render(
        page=page,
        sections=sections,
        contents=sections if len(sections) >= _LISTED_FROM else [],
        style=Markup(_asset("page.css")),
    )


class _HtmlBlocks:
    """Converts blocks to what the HTML template takes."""

    def __init__(self, colours: Colours) -> None:
        self._colours = colours

    def view(self, block: Block, *, is_half: bool = False) -> dict[str, Any]:
        """Returns a block's kind and what it shows."""
        if isinstance(block, SideBySide):
            return {
                "kind": "beside",
                "blocks": [self.view(one, is_half=True) for one in block.blocks],
            }
        if isinstance(block, Chart | MapChart | Timeline):
            svg = _drawn(block, self._colours, "svg", is_half=is_half)
            return {"kind": "figure", "figure": block, "data": _base64(svg)}
        if isinstance(block, Table):
            return {
                "kind": "table",
                "table": block,
                "rows": text_rows(block),
                "on_right": numeric_columns(block),
            }
        kinds = {Text: "text", Code: "code"}
        return {"kind": kinds[type(block)], "block": block}


def _base64(data: bytes) -> str:
    return b64encode(data).decode("ascii")


@cache
def _asset(name: str) -> str:
    return resources.files("studies.page").joinpath(name).read_text("utf-8")


def to_markdown(page: Page, folder: Path, stem: str) -> str:
    """Writes `STEM-N.png` into a folder and returns the text that shows them, for a file beside it.

    Raises:
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    writer = _MarkdownBlocks(Colours.of(page), folder, stem)
    parts = [f"# {plain(page.title)}"]
    parts += [plain(page.lead)] if page.lead else []
    if page.facts:
        rows = [[one.name, one.value, one.note] for one in page.facts]
        parts.append(_grid(["", "", ""], rows, [False, True, False]))
    for section in page.sections:
        parts.append(f"## {plain(section.title)}")
        parts += [writer.text(block) for block in section.blocks]
    return "\n\n".join(parts) + "\n"


class _MarkdownBlocks:
    """Blocks as Markdown; pictures are numbered in reading order."""

    def __init__(self, colours: Colours, folder: Path, stem: str) -> None:
        self._colours, self._folder, self._stem = colours, folder, stem
        self._numbers = count(1)

    def text(self, block: Block) -> str:
        """Returns a block as Markdown and writes its picture, if it is one."""
        if isinstance(block, SideBySide):
            return "\n\n".join(self.text(one) for one in block.blocks)
        if isinstance(block, Chart | MapChart | Timeline):
            return self._figure(block)
        if isinstance(block, Table):
            return _markdown_table(block)
        return _fenced(block) if isinstance(block, Code) else _paragraph(block)

    def _figure(self, figure: Figure) -> str:
        path = self._folder / f"{self._stem}-{next(self._numbers)}.png"
        path.write_bytes(_drawn(figure, self._colours, "png"))
        notes = f"\n\n{plain(figure.notes)}" if figure.notes else ""
        return f"![{plain(figure.title)}]({self._folder.name}/{path.name})" + notes


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


def _markdown_table(table: Table) -> str:
    caption = f"**{plain(table.caption)}**\n\n" if table.caption else ""
    return caption + _grid(
        [c.name for c in table.columns], text_rows(table), numeric_columns(table)
    )


def _grid(head: list[str], rows: list[list[str]], on_right: list[bool]) -> str:
    rule = ["--:" if right else "---" for right in on_right]
    lines = [[plain(cell) for cell in row] for row in (head, *rows)]
    lines.insert(1, rule)
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _drawn(
    figure: Figure, colours: Colours, form: Literal["png", "svg"], *, is_half: bool = False
) -> bytes:
    from studies.page.plotting import draw

    return draw(figure, colours, form, is_half=is_half)
