"""Writes a page where it is wanted."""

from __future__ import annotations

import sys
from pathlib import Path

from protocol.errors import ConfigError
from protocol.files import is_folder
from studies.page.model import Page


def save_html(page: Page, path: Path) -> None:
    """Writes a page as one HTML file.

    Raises:
        ConfigError: the file cannot be, a library is missing, or a picture cannot be read.
    """
    check_target(path)
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


def check_target(path: Path) -> None:
    """Refuses a file that could not be written, before the work of filling it.

    Raises:
        ConfigError: it is a folder, or its own folder is missing.
    """
    if is_folder(path):
        raise ConfigError(f"--html {path}: is a folder; name a file, such as {path / 'run.html'}")
    if not is_folder(path.parent):
        raise ConfigError(f"--html {path}: there is no folder {path.parent}; make it first")
