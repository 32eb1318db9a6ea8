"""Pages as Markdown: the same tables, and a picture for each chart."""

import re
from pathlib import Path

import pytest

from tests.studies.page.pages import HOSTILE, whole_page

pytest.importorskip("matplotlib", reason="extra plot")

from studies.page.write import plain, to_markdown


def test_every_chart_is_a_file_that_the_text_shows(tmp_path: Path) -> None:
    text = to_markdown(whole_page(), tmp_path / "pictures", "study")
    shown = re.findall(r"^!\[.*\]\((pictures/study-\d+\.png)\)$", text, re.M)
    assert len(shown) == len(set(shown)) == 8
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.png")} == set(shown)


def test_every_table_is_there_with_dashes_for_what_is_missing(tmp_path: Path) -> None:
    text = to_markdown(whole_page(), tmp_path, "study")
    assert "| name | n | count |\n| --- | --: | --: |" in text
    assert "| – | – | – |" in text
    assert "| 1.23 | 1,000 |" in text


def test_the_same_page_gives_the_same_files(tmp_path: Path) -> None:
    first, second = tmp_path / "first" / "p", tmp_path / "second" / "p"
    assert to_markdown(whole_page(), first, "s") == to_markdown(whole_page(), second, "s")
    for path in first.iterdir():
        assert path.read_bytes() == (second / path.name).read_bytes()


def test_names_cannot_become_marks(tmp_path: Path) -> None:
    text = to_markdown(whole_page(), tmp_path, "study")
    assert HOSTILE not in text
    assert plain("a|b\n# *c*") == r"a\|b \# \*c\*"
    assert "````\na\n```\n<b>\n````" in text
