"""Pages on the disk."""

import builtins
import sys
from pathlib import Path
from typing import Any

import pytest

from protocol.errors import ConfigError
from studies.page.model import Page
from studies.page.write import check_target, save_html

PAGE = Page("t", "", ())


def test_a_missing_library_names_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real_import = builtins.__import__

    def refuse(name: str, *rest: Any) -> object:
        if name.startswith("jinja2"):
            raise ModuleNotFoundError(f"No module named {name!r}", name="jinja2")
        return real_import(name, *rest)

    monkeypatch.delitem(sys.modules, "jinja2", raising=False)
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(
        ConfigError, match=r"needs jinja2 \(extra `study`\).* -m pip install .*'jinja2>="
    ):
        save_html(PAGE, tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_replaced_and_a_folder_is_not(tmp_path: Path) -> None:
    pytest.importorskip("jinja2", reason="extra study")
    path = tmp_path / "page.html"
    path.write_text("old")
    save_html(PAGE, path)
    assert "<h1>t</h1>" in path.read_text("utf-8")
    with pytest.raises(ConfigError, match="is a folder; name a file in it"):
        save_html(PAGE, tmp_path)


@pytest.mark.parametrize("name", ["none/page.html", "x" * 5000 + "/page.html"])
def test_a_folder_that_is_not_there_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="make it first"):
        check_target(tmp_path / name, "--html")


@pytest.mark.parametrize(("option", "name"), [("--html", "run.sqlite"), ("--markdown", "x.html")])
def test_a_report_cannot_be_written_over_what_it_is_made_from(tmp_path: Path, option, name) -> None:
    with pytest.raises(ConfigError, match="its name must end with"):
        check_target(tmp_path / name, option)
