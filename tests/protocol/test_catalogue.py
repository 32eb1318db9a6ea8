"""Plug-ins are listed without being imported, and what is wrong with one names its package."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from protocol.errors import ConfigError
from protocol.plugins import Catalogue
from tests.example_plugins import pretend

GROUP = "cpnet.test_things"
THINGS = Catalogue(GROUP, "thing", ("round", "square"))
MODULE = """
import pathlib
LOUD = 1
class Makes:
    def __init__(self, size):
        if size < 0:
            raise ValueError(f"size is {size}")
    def act(self):
        return "acted"
def nothing(size):
    return None
"""


@pytest.fixture
def offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    names = {
        "odd": "cpnet_test_odd:Makes",
        "inert": "cpnet_test_odd:nothing",
        "flat": "cpnet_test_odd:LOUD",
        "gone": "cpnet_test_odd:Missing",
        "broken": "cpnet_test_broken:Makes",
        "round": "cpnet_test_odd:Makes",
    }
    modules = {"cpnet_test_odd": MODULE, "cpnet_test_broken": "import no_such_module_anywhere"}
    pretend(tmp_path, "odd-things", {GROUP: names}, **modules)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "cpnet_test_odd", raising=False)
    return tmp_path


def test_names_are_listed_without_an_import(offered: Path) -> None:
    assert THINGS.has("odd")
    assert THINGS.checked("broken") == "broken"
    assert "odd (odd-things 1.0)" in THINGS.listed()
    assert not {"cpnet_test_odd", "cpnet_test_broken"} & sys.modules.keys()


def test_a_name_that_nobody_has_is_refused_with_all_that_there_are(offered: Path) -> None:
    for refuse in (THINGS.checked, THINGS.load):
        with pytest.raises((ValueError, ConfigError)) as caught:
            refuse("even")
        for part in ("must be one of round, square", GROUP, "odd (odd-things 1.0)"):
            assert part in str(caught.value)


def test_without_plugins_the_error_says_so() -> None:
    with pytest.raises(ValueError, match=r"round, square; installed plug-ins .*: none"):
        THINGS.checked("odd")


def test_what_is_asked_for_is_imported_and_made(offered: Path) -> None:
    plugin = THINGS.load("odd")
    assert plugin.label == "the thing odd of odd-things 1.0"
    assert plugin.make("act", 3).act() == "acted"


@pytest.mark.parametrize(
    ("name", "error_text"),
    [
        ("broken", r"the thing broken of odd-things 1\.0 cannot be imported .*no_such_module"),
        ("gone", r"of odd-things 1\.0 cannot be imported \(cpnet_test_odd:Missing\): Attribute"),
    ],
)
def test_what_cannot_be_imported_is_told_with_its_package(offered, name, error_text) -> None:
    with pytest.raises(ConfigError, match=error_text):
        THINGS.load(name)


@pytest.mark.parametrize(
    ("name", "method", "arguments", "error_text"),
    [
        ("odd", "act", (-1,), r"thing odd of odd-things 1\.0 cannot be made: ValueError: size is"),
        ("odd", "act", (), r"odd-things 1\.0 cannot be made: TypeError"),
        ("odd", "detect", (1,), r"makes a Makes, which has no method `detect`"),
        ("inert", "act", (1,), r"makes a NoneType, which has no method `act`"),
        ("flat", "act", (1,), r"thing flat of odd-things 1\.0 is a int, must be callable"),
    ],
)
def test_what_is_not_of_its_kind_is_told_with_its_package(
    offered, name, method, arguments, error_text
) -> None:
    with pytest.raises(ConfigError, match=error_text):
        THINGS.load(name).make(method, *arguments)


def test_two_packages_with_one_name_are_both_named(offered, tmp_path_factory, monkeypatch) -> None:
    other = pretend(tmp_path_factory.mktemp("other"), "other-things", {GROUP: {"odd": "a:b"}})
    monkeypatch.syspath_prepend(other)
    with pytest.raises(ConfigError, match=r"more than one package: odd-things 1\.0, other-things"):
        THINGS.load("odd")
