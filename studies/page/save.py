"""Writes a page where it is wanted."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from protocol.errors import ConfigError
from protocol.files import is_folder
from studies.page.model import Page

_ENDS = {"--html": (".html", ".htm"), "--markdown": (".md",)}


def save_html(page: Page, path: Path) -> None:
    """Writes a page as one HTML file.

    Raises:
        ConfigError: the file cannot be, a library is missing, or a picture cannot be read.
    """

    def rendered() -> str:
        from studies.page.html import to_html

        return to_html(page)

    _save(path, "--html", "study", rendered)


def save_markdown(page: Page, path: Path) -> None:
    """Writes a page as Markdown, its figures into the folder that is named like the file.

    Raises:
        ConfigError: the file cannot be, a library is missing, or a picture cannot be read.
    """

    def rendered() -> str:
        from studies.page.markdown import to_markdown

        return to_markdown(page, path.parent / path.stem, path.stem)

    _save(path, "--markdown", "plot", rendered)


def _save(path: Path, option: str, extra: str, rendered: Callable[[], str]) -> None:
    check_target(path, option)
    try:
        text = rendered()
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{option} needs {error.name} (extra `{extra}`): "
            f"{sys.executable} -m pip install 'cpnet-edge[{extra}]'"
        ) from None
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from None


def check_target(path: Path, option: str) -> None:
    """Refuses a file that could not be written, before the work of filling it.

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
