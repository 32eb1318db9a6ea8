"""Writes a page where it is wanted."""

from __future__ import annotations

import sys
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
    check_target(path, "--html")
    try:
        from studies.page.html import to_html
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"HTML needs {error.name} (extra `study`): "
            f"{sys.executable} -m pip install 'cpnet-edge[study]'"
        ) from None
    try:
        path.write_text(to_html(page), "utf-8")
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from None


def save_markdown(page: Page, path: Path) -> None:
    """Writes a page as Markdown, its figures into the folder that is named like the file.

    Raises:
        ConfigError: the file cannot be, a library is missing, or a picture cannot be read.
    """
    check_target(path, "--markdown")
    try:
        from studies.page.markdown import to_markdown
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"figures need {error.name} (extra `plot`): "
            f"{sys.executable} -m pip install 'cpnet-edge[plot]'"
        ) from None
    try:
        path.write_text(to_markdown(page, path.parent / path.stem, path.stem), "utf-8")
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
